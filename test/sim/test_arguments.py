"""Numbers on command lines: what is wrong is said in words, with what is allowed."""

import campaign
import pytest

from maasi_sim.arguments import LARGEST
from maasi_sim.experiments import reproduce
from maasi_sim.run import run_options


@pytest.mark.parametrize('seed', ['1.5', '-1', '1_0', '\u0661', 'x', str(2**63), '9' * 5000])
def test_a_seed_that_is_none_ends_with_2(seed, capsys):
    for command in (run_options, reproduce, campaign):
        with pytest.raises(SystemExit, match='2'):
            command.build_parser().parse_args([f'--seed={seed}'])
        said = capsys.readouterr().err
        assert f"--seed: read '{seed[:60]}', allowed are whole numbers from 0 to {LARGEST}" in said
