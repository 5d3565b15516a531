"""Write scripts/help/, the help that commands print before anything is set up: write_help.py."""

import contextlib
import io
import os
import re
import runpy
import sys
from pathlib import Path

SCRIPTS = Path(__file__).parent
_COMMAND = re.compile(
    r'^exec python (?:-m (?P<module>[\w.]+)|"\$maasi_root/(?P<file>\S+)") "\$@"$', re.M
)


def helps() -> dict[str, str]:
    """Return the help of each command that has a parser, by name."""
    os.environ['COLUMNS'] = '100'
    found = {}
    for script in sorted(SCRIPTS.iterdir()):
        match = script.is_file() and _COMMAND.search(script.read_text())
        if not match:
            continue
        sys.argv[:] = [script.name, '--help']
        text = io.StringIO()
        with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
            if match['module']:
                runpy.run_module(match['module'], run_name='__main__')
            else:
                file = SCRIPTS.parent / match['file']
                sys.path.insert(0, str(file.parent))
                runpy.run_path(str(file), run_name='__main__')
        found[script.name] = text.getvalue()
    return found


if __name__ == '__main__':
    for name, text in helps().items():
        (SCRIPTS / 'help' / f'{name}.txt').write_text(text)
