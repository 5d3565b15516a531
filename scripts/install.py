"""Install packages with uv, which is several times as fast as pip: `install.py [PIP OPTIONS]`.

uv follows the indexes, folders of wheels and certificate of pip's configuration. Where it is not
found, cannot be installed or fails, pip does the work.
"""

import ast
import os
import shutil
import subprocess
import sys

UV = 'uv==0.13.9'
# Options of pip's configuration that decide where packages come from, and what uv calls them.
OPTIONS = {
    'index-url': '--default-index',
    'extra-index-url': '--index',
    'find-links': '--find-links',
}


def pip(*arguments: str) -> int:
    """Run pip and return its exit code."""
    return subprocess.call([sys.executable, '-m', 'pip', '--disable-pip-version-check', *arguments])


def configuration() -> dict[str, str]:
    """Return pip's configuration: files and environment, the latter last."""
    run = [sys.executable, '-m', 'pip', 'config', 'list']
    text = subprocess.run(run, capture_output=True, text=True, check=True).stdout
    pairs = sorted(line.split('=', 1) for line in text.splitlines() if '=' in line)
    values: dict[str, str] = {}
    # Sorted, `:env:` comes first, so `setdefault` prefers it.
    for name, value in pairs:
        values.setdefault(name.rpartition('.')[2], ast.literal_eval(value))
    return values


def uv_command(uv: str, arguments: list[str]) -> tuple[list[str], dict[str, str]]:
    """Return the command of uv that does what pip would do, and its environment."""
    values = configuration()
    places = [
        part
        for name, option in OPTIONS.items()
        for place in values.get(name, '').split()
        for part in (option, place)
    ]
    environment = dict(os.environ)
    if 'cert' in values:
        environment.setdefault('SSL_CERT_FILE', values['cert'])
    # pip takes the best version of all indexes.
    command = [uv, 'pip', 'install', '--python', sys.executable, *places]
    return [*command, '--index-strategy', 'unsafe-best-match', *arguments], environment


def main() -> int:
    """Install what the arguments name."""
    arguments = sys.argv[1:]
    uv = shutil.which('uv', path=os.path.dirname(sys.executable)) or shutil.which('uv')
    if uv is None and pip('install', '--quiet', UV) == 0:
        uv = shutil.which('uv', path=os.path.dirname(sys.executable))
    if uv is not None:
        command, environment = uv_command(uv, arguments)
        if subprocess.call(command, env=environment) == 0:
            return 0
        print('uv failed; installing with pip', flush=True)
    return pip('install', *arguments)


if __name__ == '__main__':
    sys.exit(main())
