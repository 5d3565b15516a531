"""Write requirements with an end of what setup.py allows: `... newest|oldest FOLDER`.

The newest are what a fresh installation gets, the oldest are the lower bounds themselves.
"""

import ast
import pathlib
import re
import sys

ROOT = pathlib.Path(__file__).parents[1]
# Name; lower bound; the rest.
_ALLOWED = re.compile(r'([\w.-]+)>=([\w.]+)(.*)')


def allowed() -> dict[str, tuple[str, str]]:
    """Return lower bound and the whole requirement of each dependency, by name."""
    found: dict[str, tuple[str, str]] = {}
    for file in sorted(ROOT.glob('*/setup.py')):
        calls = [
            node for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.Call)
        ]
        call = next(node for node in calls if getattr(node.func, 'id', '') == 'setup')
        parts = {
            item.arg: ast.literal_eval(item.value)
            for item in call.keywords
            if item.arg in ('install_requires', 'extras_require')
        }
        extras = parts.get('extras_require', {}).values()
        for text in sum(extras, parts.get('install_requires', [])):
            if text.startswith('maasi_'):
                continue
            match = _ALLOWED.fullmatch(text)
            if match is None:
                sys.exit(f'error: {file}: read {text!r}, allowed are requirements with >=')
            name, lowest = match[1], match[2]
            if found.setdefault(name, (lowest, text)) != (lowest, text):
                sys.exit(f'error: {file}: read {text!r}, another package has {found[name][1]!r}')
    return found


def main() -> None:
    end, folder = sys.argv[1], pathlib.Path(sys.argv[2])
    found = allowed()
    folder.mkdir(parents=True, exist_ok=True)
    lines = [f'{name}=={low}' if end == 'oldest' else text for name, (low, text) in found.items()]
    (folder / 'requirements.txt').write_text('\n'.join([*lines, '']))
    names = {name.lower() for name in found}
    for file in ROOT.glob('requirements-*.txt'):
        kept = [
            line
            for line in file.read_text().splitlines()
            if re.split(r'[^\w.-]', line, maxsplit=1)[0].lower() not in names
        ]
        (folder / file.name).write_text('\n'.join([*kept, '']))


if __name__ == '__main__':
    main()
