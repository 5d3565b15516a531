"""Point the CMake files of the ROS wheels at this environment instead of at their build machine."""

import pathlib
import re
import sys
import sysconfig

import numpy


def mend(text: str) -> str:
    """Replace the include folders of the build machine's Python and NumPy."""
    text = re.sub(
        r'/opt/python/cp\d+-cp\d+/lib/python[\d.]+/site-packages/numpy/_core/include',
        numpy.get_include(),
        text,
    )
    return re.sub(
        r'/opt/python/cp\d+-cp\d+/include/python[\d.]+', sysconfig.get_path('include'), text
    )


def main() -> None:
    for path in pathlib.Path(sys.prefix, 'share').rglob('*.cmake'):
        text = path.read_text()
        fixed = mend(text)
        if fixed != text:
            path.write_text(fixed)


if __name__ == '__main__':
    main()
