"""Make the page or a video of a recorded run."""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from maasi_sim.arguments import Parser
from maasi_sim.run.bag import BagError
from maasi_sim.run.progress import ProgressDisplay
from maasi_sim.run.run_folder import ResultsError
from maasi_sim.run.view.page_file import REPLAY, open_browser, write_replay
from maasi_sim.run.view.recording import read_events

DONE, WRONG_INPUT, NOT_WRITTEN = 0, 2, 4


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = Parser(
        prog='view',
        description=f'Make {REPLAY}, a page that contains the complete run, and open it.',
        epilog='Exit codes: 0 done, 2 no recording of a search, 4 the page could not be written.',
    )
    add = parser.add_argument
    add(
        'recording',
        type=Path,
        nargs='?',
        metavar='BAG_OR_RUN',
        help='recording or folder of a run (default: the newest in runs)',
    )
    add(
        '--out',
        type=Path,
        metavar='FILE',
        help=f'page (default: {REPLAY} in the folder of the run)',
    )
    add(
        '--video',
        type=Path,
        metavar='FILE',
        help='make a video instead of a page: FILE.mp4 or FILE.gif',
    )
    add(
        '--speed',
        type=float,
        default=5.0,
        metavar='X',
        help='play the video at X times real time (default: 5)',
    )
    add('--no-browser', dest='browser', action='store_false', help='do not open a browser')
    return parser


def send_replay(folder: Path, send: Callable[[Any], None]) -> None:
    """Write the page of a run next to its report; send the completed shares, then any error."""
    try:
        write_replay(read_events(folder, send), folder / REPLAY)
        send('')
    except (BagError, ResultsError) as error:
        send(str(error))


def main(arguments: list[str] | None = None) -> int:
    """Run the command line."""
    parser = build_parser()
    options = parser.parse_args(arguments)
    if options.video is not None and options.video.suffix not in ('.mp4', '.gif'):
        parser.error(f"--video: read '{options.video}', allowed are FILE.mp4 and FILE.gif")
    if not 0.0 < options.speed < 1e4:
        parser.error(f"--speed: read '{options.speed:g}', allowed are numbers above 0, below 1e4")
    bags = sorted(Path('runs').glob('*/bag/metadata.yaml'), key=lambda item: item.stat().st_mtime)
    if options.recording is None and not bags:
        parser.error('runs contains no run: name a recording')
    recording = options.recording or bags[-1].parents[1]
    display = ProgressDisplay()
    try:
        log = read_events(recording, partial(display.share, 'reading'))
        if options.video is not None:
            # Deferred: Matplotlib takes long to import.
            from maasi_sim.run.view.video import write_video

            file, share = options.video, partial(display.share, options.video.name)
            write_video(log, file, options.speed, share)
            display.close()
            print(file)
            return DONE
        # In the folder of its run, or next to the recording.
        folder = recording if (recording / 'bag').is_dir() else recording.resolve().parent
        file = options.out or folder / REPLAY
        write_replay(log, file)
    except BagError as error:
        display.say(f'error: {error}')
        return WRONG_INPUT
    except (ResultsError, OSError) as error:
        display.say(f'error: {error}')
        return NOT_WRITTEN
    finally:
        display.close()
    print(file)
    if options.browser:
        open_browser(file.resolve().as_uri())
    return DONE


if __name__ == '__main__':
    raise SystemExit(main())
