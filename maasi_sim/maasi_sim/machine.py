"""The machine of a run, as far as it changes the last bits (docs/repeatability.md)."""

import hashlib
import platform
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

# Names of differences, if not the key.
_NAMES = {
    'features': 'processor features',
    'python': 'Python',
    'numpy': 'NumPy',
    'scipy': 'SciPy',
    'numba': 'Numba',
    'cv2': 'OpenCV',
}
# Packages of a search in one process.
_SEARCH = (
    'maasi_filter',
    'maasi_planner',
    'maasi_drivers',
    'maasi_sim.scenario',
    'maasi_sim.simulation',
    'maasi_sim.run.facts',
    'maasi_sim.run.log',
    'maasi_sim.run.scores',
    'maasi_sim.search',
    'maasi_sim.search_result',
)
_LIBRARIES = ('numpy', 'scipy', 'numba', 'llvmlite', 'cv2')


@cache
def _facts() -> dict[str, str]:
    from numba.core.registry import cpu_target

    # Target of compiled kernels, including NUMBA_CPU_NAME and NUMBA_CPU_FEATURES.
    _, processor, features = cpu_target.target_context.codegen().magic_tuple()
    return {
        'processor': processor,
        'features': hashlib.sha256(features.encode()).hexdigest()[:12],
        'python': platform.python_version(),
        **{name: import_module(name).__version__ for name in _LIBRARIES},
    }


def this_machine() -> dict[str, str]:
    """Return processor, hash of its features, and versions."""
    return dict(_facts())


def machine_difference(first: Mapping[str, str], second: Mapping[str, str]) -> str:
    """Return the differences of two results of `this_machine` as text, '' if none."""
    keys = dict.fromkeys([*first, *second])
    return ', '.join(
        f'{_NAMES.get(key, key)} {second.get(key, "unknown")} instead of '
        f'{first.get(key, "unknown")}'
        for key in keys
        if first.get(key) != second.get(key)
    )


@cache
def code_digest() -> str:
    """Return a short hash of the code of a search."""
    total = hashlib.sha256()
    for name in _SEARCH:
        spec = find_spec(name)
        assert spec is not None and spec.origin is not None, name
        origin = Path(spec.origin)
        files = origin.parent.rglob('*.py') if spec.submodule_search_locations else [origin]
        for path in sorted(files):
            total.update(path.relative_to(origin.parent).as_posix().encode())
            total.update(path.read_bytes())
    return total.hexdigest()[:16]
