# Sets up what is missing (virtual environment, ROS 2 Jazzy wheels, build of all packages) and
# exports the environment in which the commands run. Sourced by the commands in this folder.
#   PYTHON            interpreter to use (3.10 to 3.13)
#   MAASI_WORKSPACE   where environment and build go (default: .workspace in the repository)

maasi_root="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
maasi_workspace="${MAASI_WORKSPACE:-$maasi_root/.workspace}"
maasi_venv="$maasi_workspace/venv"

maasi_fail() {
  printf 'error: %s\n' "$@" >&2
  exit 2
}

maasi_find_python() {
  local candidate
  for candidate in ${PYTHON:-python3 python3.12 python3.11 python3.13 python3.10}; do
    if "$candidate" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' \
        2> /dev/null; then
      command -v "$candidate"
      return
    fi
  done
  maasi_fail "no Python 3.10 to 3.13 was found${PYTHON:+ at PYTHON=$PYTHON}" \
    'install one, for example: sudo apt install python3 python3-venv'
}

maasi_hash() { sha256sum | cut -d ' ' -f 1; }

# A sourced Jazzy is used as it is, the wheels only where there is none.
maasi_has_jazzy() {
  [ "${ROS_DISTRO:-}" = jazzy ] && [ -z "${MAASI_WHEELS:-}" ] && "$1" -c 'import rclpy' 2> /dev/null
}

maasi_make_venv() {
  local python="$1" mode="$2" key="$3"
  local requirements=(-r "$maasi_root/requirements.txt" -r "$maasi_root/requirements-build.txt")
  local log="$maasi_workspace/setup.log"
  "$python" -c 'import venv, ensurepip' 2> /dev/null \
    || maasi_fail "$python has no venv module" 'install it: sudo apt install python3-venv'
  rm -rf "$maasi_venv" "$maasi_workspace/build" "$maasi_workspace/install"
  mkdir -p "$maasi_workspace"
  if [ "$mode" = jazzy ]; then
    echo "Setting up: virtual environment beside the sourced ROS 2 Jazzy ..." >&2
    "$python" -m venv --system-site-packages "$maasi_venv"
    # The messages of the sourced Jazzy are compiled against its NumPy: keep that version.
    "$python" -c 'import numpy; print("numpy==" + numpy.__version__)' \
      > "$maasi_workspace/constraints.txt"
    requirements+=(-c "$maasi_workspace/constraints.txt")
  else
    echo "Setting up: virtual environment and ROS 2 Jazzy wheels (a few minutes, once) ..." >&2
    "$python" -m venv "$maasi_venv"
    requirements+=(-r "$maasi_root/requirements-ros.txt")
  fi
  if ! "$maasi_venv/bin/python" -m pip install --disable-pip-version-check \
      "${requirements[@]}" > "$log" 2>&1; then
    tail -n 15 "$log" >&2
    maasi_fail "installing the Python packages failed; the whole log: $log"
  fi
  [ "$mode" = jazzy ] || "$maasi_venv/bin/python" "$maasi_root/scripts/mend_wheels.py"
  echo "$key" > "$maasi_venv/.maasi_key"
}

# What only the tests and benchmarks (tests), or the API reference (docs) need.
maasi_install() {
  local what="$1" requirements="$maasi_root/requirements-test.txt" key
  local log="$maasi_workspace/setup_$what.log"
  [ "$what" = tests ] || requirements="$maasi_root/requirements-$what.txt"
  key="$(maasi_hash < "$requirements")"
  [ "$(cat "$maasi_venv/.maasi_${what}_key" 2> /dev/null)" != "$key" ] || return 0
  echo "Setting up: what the $what need ..." >&2
  if ! "$maasi_venv/bin/python" -m pip install --disable-pip-version-check \
      -r "$requirements" -c "$maasi_root/requirements.txt" > "$log" 2>&1; then
    tail -n 15 "$log" >&2
    maasi_fail "installing the $what requirements failed; the whole log: $log"
  fi
  echo "$key" > "$maasi_venv/.maasi_${what}_key"
}

# The wheels have no tf2_msgs; one that is installed is used as it is.
maasi_own_interfaces() {
  "$maasi_venv/bin/python" -c 'import tf2_msgs.msg' 2> /dev/null || echo scripts/interfaces/tf2_msgs
}

maasi_build() {
  local key="$1" log="$maasi_workspace/build.log"
  command -v c++ > /dev/null || command -v g++ > /dev/null || command -v clang++ > /dev/null \
    || maasi_fail 'no C++ compiler was found' 'install one: sudo apt install build-essential'
  command -v make > /dev/null \
    || maasi_fail 'make was not found' 'install it: sudo apt install build-essential'
  echo "Building the packages ..." >&2
  if ! (
    cd "$maasi_root" || exit 1
    export COLCON_LOG_PATH="$maasi_workspace/log"
    # shellcheck disable=SC2046
    "$maasi_venv/bin/python" -m colcon build --symlink-install \
      --base-paths maasi_msgs maasi_filter maasi_planner maasi_drivers maasi_sim config \
      $(maasi_own_interfaces) \
      --build-base "$maasi_workspace/build" --install-base "$maasi_workspace/install" \
      --cmake-args "-DPython3_EXECUTABLE=$maasi_venv/bin/python" -DBUILD_TESTING=OFF \
      --no-warn-unused-cli
  ) > "$log" 2>&1; then
    tail -n 30 "$log" >&2
    maasi_fail "the build failed; the whole log: $log"
  fi
  echo "$key" > "$maasi_workspace/install/.maasi_key"
}

# What a symlinked install does not follow by itself: interfaces, manifests, new or lost files.
maasi_build_key() {
  (
    cd "$maasi_root" || exit 1
    find maasi_msgs scripts/interfaces maasi_*/setup.* maasi_*/package.xml config/setup.* config/package.xml \
      -type f -print0 | sort -z | xargs -0 sha256sum
    find maasi_*/launch config -type f -not -path "*__pycache__*" | sort
    echo "$1"
  ) | maasi_hash
}

# Compiled kernels do not notice that a kernel they call in another file has changed, so each
# state of the sources has a folder of its own. Compiled here, so that no node waits for it.
maasi_compile() {
  local key
  key="$(cd "$maasi_root" && grep -rl --include='*.py' njit maasi_*/maasi_* | sort \
    | xargs cat | maasi_hash)"
  export NUMBA_CACHE_DIR="$maasi_workspace/numba/${key:0:16}"
  [ ! -e "$NUMBA_CACHE_DIR/complete" ] && [ -z "${NUMBA_DISABLE_JIT:-}" ] || return 0
  echo "Compiling (a few minutes, once) ..." >&2
  if ! python "$maasi_root/scripts/compile_kernels.py" > "$maasi_workspace/compile.log" 2>&1; then
    tail -n 15 "$maasi_workspace/compile.log" >&2
    maasi_fail "compiling failed; the whole log: $maasi_workspace/compile.log"
  fi
  touch "$NUMBA_CACHE_DIR/complete"
}

maasi_set_up() {
  local python mode key
  python="$(maasi_find_python)" || exit 2
  if maasi_has_jazzy "$python"; then mode=jazzy; else mode=wheels; fi
  key="$( (cat "$maasi_root"/requirements.txt "$maasi_root"/requirements-build.txt \
    "$maasi_root"/requirements-ros.txt "$maasi_root/scripts/mend_wheels.py"
    "$python" -c 'import sys; print(sys.version, sys.base_prefix)'; echo "$mode $maasi_venv") | maasi_hash)"
  mkdir -p "$maasi_workspace"
  exec {maasi_lock}> "$maasi_workspace/lock"
  flock "$maasi_lock"
  [ "$(cat "$maasi_venv/.maasi_key" 2> /dev/null)" = "$key" ] \
    || maasi_make_venv "$python" "$mode" "$key"
  if [ "$mode" = wheels ]; then
    export AMENT_PREFIX_PATH="$maasi_venv" CMAKE_PREFIX_PATH="$maasi_venv"
    export ROS_DISTRO=jazzy MAASI_WHEELS=1
    unset PYTHONPATH
  fi
  export PATH="$maasi_venv/bin:$PATH"
  key="$(maasi_build_key "$key")"
  [ "$(cat "$maasi_workspace/install/.maasi_key" 2> /dev/null)" = "$key" ] || maasi_build "$key"
  # The generated file reads unset variables.
  set +u
  # shellcheck disable=SC1091
  source "$maasi_workspace/install/local_setup.bash"
  maasi_compile
  flock -u "$maasi_lock"
  exec {maasi_lock}>&-
}

maasi_set_up
