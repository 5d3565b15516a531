# Sets up what is missing (virtual environment, ROS 2 wheels, build of all packages) and
# exports the environment in which the commands run. Sourced by the commands in this folder.
#   PYTHON            interpreter to use (3.10 to 3.14)
#   MAASI_ROS_DISTRO  ROS 2 to use (default: the sourced one, otherwise jazzy)
#   MAASI_REQUIREMENTS   folder of requirements*.txt (default: the repository)
#   MAASI_WORKSPACE   where environment and build go (default: .workspace in the repository;
#                     .workspace/kilted for kilted)

# The help of a command answers before anything is set up.
case "${1:-}" in
  -h|--help)
    maasi_help="${BASH_SOURCE[1]:-}"
    maasi_help="${maasi_help%/*}/help/${maasi_help##*/}.txt"
    [ ! -f "$maasi_help" ] || { cat "$maasi_help" && exit; }
    ;;
esac

maasi_root="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
maasi_requirements="${MAASI_REQUIREMENTS:-$maasi_root}"

maasi_fail() {
  printf 'error: %s\n' "$1" >&2
  shift
  [ $# = 0 ] || printf '  %s\n' "$@" >&2
  exit 2
}

maasi_find_python() {
  local candidate
  for candidate in ${PYTHON:-python3 python3.12 python3.11 python3.13 python3.10 python3.14}; do
    # The interpreter itself, not what chooses one at each call.
    "$candidate" -ISc 'import sys
(3, 10) <= sys.version_info[:2] <= (3, 14) or sys.exit(1)
print(sys.executable)' 2> /dev/null && return
  done
  maasi_fail "no Python 3.10 to 3.14 was found${PYTHON:+ at PYTHON=$PYTHON}" \
    'install one, for example: sudo apt install python3 python3-venv'
}

maasi_hash() { sha256sum | cut -d ' ' -f 1; }

# Prints the distribution of ROS 2, and `sourced` or `wheels`. A sourced one is used as it is, the
# wheels only where there is none, or an older one that was not asked for.
maasi_choose_ros() {
  local distro="${MAASI_ROS_DISTRO:-${ROS_DISTRO:-jazzy}}"
  if [ "$distro" = "${ROS_DISTRO:-}" ] && [ -z "${MAASI_WHEELS:-}" ] \
      && "$1" -c 'import rclpy' 2> /dev/null; then
    if [ "$distro" = jazzy ] || [ "$distro" = kilted ]; then
      echo "$distro sourced"
      return
    fi
    if [ -n "${MAASI_ROS_DISTRO:-}" ] || [[ "$distro" > kilted ]]; then
      echo "warning: using the sourced ROS 2 $distro; tested are jazzy and kilted" >&2
      echo "$distro sourced"
      return
    fi
    echo "warning: the sourced ROS 2 $distro is older than jazzy: using jazzy from PyPI" \
      "(MAASI_ROS_DISTRO=$distro uses the sourced one)" >&2
  fi
  case "$distro" in
    jazzy|kilted) ;;
    *)
      [ -z "${MAASI_ROS_DISTRO:-}" ] || maasi_fail "MAASI_ROS_DISTRO=$distro: $1 finds no such ROS 2" \
        "source it (/opt/ros/$distro/setup.bash), or set jazzy or kilted, which are installed from PyPI"
      distro=jazzy
      ;;
  esac
  echo "$distro wheels"
}

maasi_make_venv() {
  local python="$1" key="$2"
  local requirements=(-r "$maasi_requirements/requirements.txt" -r "$maasi_requirements/requirements-build.txt")
  local log="$maasi_workspace/setup.log"
  "$python" -c 'import venv, ensurepip' 2> /dev/null \
    || maasi_fail "$python has no venv module" 'install it: sudo apt install python3-venv'
  rm -rf "$maasi_venv" "$maasi_workspace/build" "$maasi_workspace/install"
  mkdir -p "$maasi_workspace"
  if [ "$maasi_mode" = sourced ]; then
    echo "Setting up: Python packages for the sourced ROS 2 ${maasi_distro^} (downloads about 150 MB) ..." >&2
    "$python" -m venv --system-site-packages "$maasi_venv"
    # The messages of the sourced ROS 2 are compiled against its NumPy: keep that version.
    "$python" -c 'import numpy; print("numpy==" + numpy.__version__)' \
      > "$maasi_workspace/constraints.txt"
    requirements+=(-c "$maasi_workspace/constraints.txt")
  else
    echo "Setting up: ROS 2 ${maasi_distro^} and Python packages as wheels (downloads about 250 MB) ..." >&2
    # What another ROS 2 has there would be taken as installed.
    unset PYTHONPATH
    "$python" -m venv "$maasi_venv"
    requirements+=(-r "$maasi_requirements/requirements-$maasi_distro.txt")
  fi
  if ! "$maasi_venv/bin/python" "$maasi_root/scripts/install.py" "${requirements[@]}" > "$log" 2>&1; then
    tail -n 15 "$log" >&2
    maasi_fail "installing the Python packages failed; the whole log: $log"
  fi
  [ "$maasi_mode" = sourced ] || "$maasi_venv/bin/python" "$maasi_root/scripts/mend_wheels.py"
  echo "$key" > "$maasi_venv/.maasi_key"
}

# What only the tests and benchmarks (tests), or the API reference (docs) need.
maasi_install() {
  local what="$1" requirements="$maasi_requirements/requirements-test.txt" key
  local log="$maasi_workspace/setup_$what.log"
  [ "$what" = tests ] || requirements="$maasi_requirements/requirements-$what.txt"
  key="$(maasi_hash < "$requirements")"
  [ "$(cat "$maasi_venv/.maasi_${what}_key" 2> /dev/null)" != "$key" ] || return 0
  echo "Setting up: what the $what need, as wheels ..." >&2
  if ! "$maasi_venv/bin/python" "$maasi_root/scripts/install.py" -r "$requirements" \
      -c "$maasi_requirements/requirements.txt" > "$log" 2>&1; then
    tail -n 15 "$log" >&2
    maasi_fail "installing the $what requirements failed; the whole log: $log"
  fi
  echo "$key" > "$maasi_venv/.maasi_${what}_key"
}

# The wheels have neither tf2_msgs nor vision_msgs; what is installed is used as it is.
maasi_own_interfaces() {
  local package
  for package in tf2_msgs vision_msgs; do
    "$maasi_venv/bin/python" -c "import $package.msg" 2> /dev/null \
      || echo "scripts/interfaces/$package"
  done
}

maasi_build() {
  local key="$1" log="$maasi_workspace/build.log"
  command -v c++ > /dev/null || command -v g++ > /dev/null || command -v clang++ > /dev/null \
    || maasi_fail 'no C++ compiler was found' 'install one: sudo apt install build-essential'
  command -v make > /dev/null \
    || maasi_fail 'make was not found' 'install it: sudo apt install build-essential'
  echo "Setting up: messages and packages, by colcon and the C++ compiler (a minute or two) ..." >&2
  if ! (
    cd "$maasi_root" || exit 1
    export COLCON_LOG_PATH="$maasi_workspace/log"
    # shellcheck disable=SC2046
    "$maasi_venv/bin/python" -m colcon build --symlink-install \
      --base-paths maasi_msgs maasi_filter maasi_planner maasi_drivers maasi_sim config \
      $(maasi_own_interfaces) \
      --build-base "$maasi_workspace/build" --install-base "$maasi_workspace/install" \
      --cmake-args "-DPython3_EXECUTABLE=$maasi_venv/bin/python" -DBUILD_TESTING=OFF \
      -DJOIN_SOURCES=ON ${MAASI_WHEELS:+-DWITHOUT_CPP=ON} --no-warn-unused-cli
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

# Python finds the packages in the repository, before they are built and as they are edited.
maasi_source_path() {
  printf '%s:' "$maasi_root"/maasi_{filter,planner,drivers,sim}
}

# Compiled kernels do not notice that a kernel they call in another file has changed, so each
# state of the sources has a folder of its own.
maasi_kernels() {
  local key
  key="$(cd "$maasi_root" && grep -rl --include='*.py' njit maasi_*/maasi_* | sort \
    | xargs cat | maasi_hash)"
  echo "$maasi_workspace/numba/${key:0:16}"
}

maasi_needs_compiling() { [ ! -e "$1/complete" ] && [ -z "${NUMBA_DISABLE_JIT:-}" ]; }

# Compiles all kernels, so that no node waits for it; becomes the compiling process.
maasi_compile() {
  echo "Setting up: numerical kernels, by Numba (a minute or two, during the build) ..." >&2
  export NUMBA_CACHE_DIR="$1" PYTHONPATH="$(maasi_source_path)${PYTHONPATH:-}"
  exec "$maasi_venv/bin/python" "$maasi_root/scripts/compile_kernels.py" \
    > "$maasi_workspace/compile.log" 2>&1
}

# Does what is missing, in a shell of its own: an error does not close the shell of a user.
maasi_set_up() (
  set +e
  local python="$1" key compiling='' kernels
  if ! mkdir -p "$maasi_workspace" 2> /dev/null || ! [ -w "$maasi_workspace" ]; then
    maasi_fail "cannot write to $maasi_workspace" 'name a folder for it: MAASI_WORKSPACE=FOLDER'
  fi
  exec {maasi_lock}> "$maasi_workspace/lock"
  flock "$maasi_lock"
  key="$( (cat "$maasi_requirements"/requirements.txt "$maasi_requirements"/requirements-build.txt
    if [ "$maasi_mode" = wheels ]; then cat "$maasi_requirements/requirements-$maasi_distro.txt"
    else echo "$maasi_distro"; fi
    cat "$maasi_root/scripts/mend_wheels.py"
    "$python" -ISc 'import sys; print(sys.version, sys.base_prefix)'; echo "$maasi_mode $maasi_venv") | maasi_hash)"
  [ "$(cat "$maasi_venv/.maasi_key" 2> /dev/null)" = "$key" ] \
    || maasi_make_venv "$python" "$key"
  maasi_use_venv
  kernels="$(maasi_kernels)"
  if maasi_needs_compiling "$kernels"; then
    maasi_compile "$kernels" &
    compiling=$!
    # A build that fails or is interrupted ends the compilation too.
    trap 'kill "$compiling" 2> /dev/null' EXIT
  fi
  key="$(maasi_build_key "$key")"
  [ "$(cat "$maasi_workspace/install/.maasi_key" 2> /dev/null)" = "$key" ] || maasi_build "$key"
  [ -n "$compiling" ] || return 0
  if ! wait "$compiling"; then
    tail -n 15 "$maasi_workspace/compile.log" >&2
    maasi_fail "compiling failed; the whole log: $maasi_workspace/compile.log"
  fi
  touch "$kernels/complete"
)

maasi_use_venv() {
  if [ "$maasi_mode" = wheels ]; then
    export AMENT_PREFIX_PATH="$maasi_venv" CMAKE_PREFIX_PATH="$maasi_venv"
    export ROS_DISTRO="$maasi_distro" MAASI_WHEELS=1
    unset PYTHONPATH
  fi
  export PATH="$maasi_venv/bin:$PATH"
  # Next to the environment, not in the repository; without them each start takes seconds longer.
  export PYTHONPYCACHEPREFIX="$maasi_workspace/pycache"
  unset PYTHONDONTWRITEBYTECODE
}

maasi_use() {
  local nounset=+u
  maasi_use_venv
  # The generated file reads unset variables.
  case $- in *u*) nounset=-u ;; esac
  set +u
  # shellcheck disable=SC1091
  source "$maasi_workspace/install/local_setup.bash"
  PYTHONPATH="$(maasi_source_path)${PYTHONPATH:-}"
  export PYTHONPATH
  # The wheels have no `ros2`: what `ros2 run` starts is called by its name.
  PATH="$PATH$(printf ':%s' "$maasi_workspace"/install/*/lib/maasi_*)"
  set "$nounset"
  NUMBA_CACHE_DIR="$(maasi_kernels)"
  export NUMBA_CACHE_DIR
}

maasi_python="$(maasi_find_python)" && maasi_ros="$(maasi_choose_ros "$maasi_python")" \
  || case $- in *i*) return 2 ;; *) exit 2 ;; esac
maasi_distro="${maasi_ros% *}" maasi_mode="${maasi_ros#* }"
maasi_workspace=.workspace
[ "$maasi_distro" = jazzy ] || maasi_workspace=".workspace/$maasi_distro"
maasi_workspace="${MAASI_WORKSPACE:-$maasi_root/$maasi_workspace}"
case "$maasi_workspace" in /*) ;; *) maasi_workspace="$PWD/$maasi_workspace" ;; esac
maasi_venv="$maasi_workspace/venv"
maasi_set_up "$maasi_python" || case $- in *i*) return 2 ;; *) exit 2 ;; esac
maasi_use
