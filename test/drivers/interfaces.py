"""Message packages of other systems: their own, or the ones of this folder, built once."""

import hashlib
import json
import os
import queue
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

HERE = Path(__file__).parent


def with_interfaces(name, cache):
    """Return an environment in which the package `name` can be imported."""
    probe = [sys.executable, '-c', f'import {name}']
    if subprocess.run(probe, capture_output=True, check=False).returncode == 0:
        return os.environ.copy()
    source = HERE / name
    content = b''.join(path.read_bytes() for path in sorted(source.rglob('*')) if path.is_file())
    key = hashlib.sha256(content + sys.version.encode()).hexdigest()[:12]
    folder = Path(cache.mkdir('maasi_interfaces')) / f'{name}_{key}'
    install = folder / 'install'
    if not (folder / 'built').exists():
        command = [sys.executable, '-m', 'colcon', '--log-base', str(folder / 'log'), 'build']
        command += ['--base-paths', str(source), '--merge-install']
        command += ['--build-base', str(folder / 'build'), '--install-base', str(install)]
        command += ['--cmake-args', f'-DPython3_EXECUTABLE={sys.executable}']
        command += ['-DCMAKE_BUILD_TYPE=Debug', '-DBUILD_TESTING=OFF', '--no-warn-unused-cli']
        built = subprocess.run(command, capture_output=True, text=True, check=False)
        assert built.returncode == 0, built.stdout + built.stderr
        (folder / 'built').touch()
    environment = os.environ.copy()
    python = next(install.glob('lib/python*/site-packages'))
    for variable, path in (
        ('AMENT_PREFIX_PATH', install),
        ('LD_LIBRARY_PATH', install / 'lib'),
        ('PYTHONPATH', python),
    ):
        old = environment.get(variable, '')
        environment[variable] = f'{path}{os.pathsep}{old}'.rstrip(os.pathsep)
    return environment


@contextmanager
def played(environment, *words):
    """Run a script of this folder; yield a queue of the lines that it prints, and its process."""
    environment = environment | {
        name: os.environ[name] for name in ('ROS_DOMAIN_ID', 'ROS_AUTOMATIC_DISCOVERY_RANGE')
    }
    command = [sys.executable, str(HERE / words[0]), *words[1:]]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
    said = queue.Queue()

    def read():
        for line in process.stdout:
            said.put(json.loads(line))

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    try:
        assert said.get(timeout=60.0)['event'] == 'ready'
        yield said, process
    finally:
        process.kill()
        process.wait()
        reader.join()
