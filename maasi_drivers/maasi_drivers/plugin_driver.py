"""Runs a user's driver: `plugin_driver module:Class`, or an installed one by its name."""

import sys

from maasi_drivers.settings.driver import DRIVERS
from maasi_filter.plugins import PluginError, add_folders

_USAGE = """usage: plugin_driver [--check] NAME [FOLDER ...] [--ros-args ...]

Run your own driver as a node: a subclass of maasi_drivers.agent.agent_driver.AgentDriver.
  NAME      module:Class, or the name of an installed plugin
  FOLDER    folder of modules, in addition to the current one
  --check   only check that it can be loaded"""


def main(arguments: list[str] | None = None) -> int:
    """Run the driver; exit code 2 if it cannot be loaded."""
    words = sys.argv[1:] if arguments is None else arguments
    end = words.index('--ros-args') if '--ros-args' in words else len(words)
    given = [word for word in words[:end] if not word.startswith('-')]
    if not given:
        print(_USAGE, file=sys.stdout if {'-h', '--help'} & set(words) else sys.stderr)
        return 0 if {'-h', '--help'} & set(words) else 2
    name, *folders = given
    add_folders(folders)
    try:
        driver = DRIVERS.load(name)
    except PluginError as error:
        print(f'error: {error}', file=sys.stderr)
        return 2
    if '--check' in words[:end]:
        return 0
    from maasi_filter.ros.run_node import run

    helping = [word for word in ('-h', '--help') if word in words[:end]]
    return run(driver, [*helping, *words[end:]])


if __name__ == '__main__':
    raise SystemExit(main())
