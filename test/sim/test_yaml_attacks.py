"""YAML files that are wrong in unkind ways: one short message with file and line, at once."""

import pytest

from maasi_sim.scenario.layering import ScenarioError, read_layer

BOMB = 'a0: &a0 [x, x, x, x, x, x, x, x, x]\n' + ''.join(
    f'a{n}: &a{n} [{", ".join([f"*a{n - 1}"] * 9)}]\n' for n in range(1, 12)
)


@pytest.mark.parametrize(
    'text, words',
    [
        ('version: 1\nx: &a [*a]\n', ':2: an alias stands inside its own anchor'),
        ('x: &a {b: {c: *a}}\n', ':1: an alias stands inside its own anchor'),
        ('version: 1\nname: a\x07b\n', ':2: is not YAML: read character 0x7'),
        (BOMB, 'read more than 100000 entries'),
        ('x: ' + '[' * 3000 + ']' * 3000 + '\n', 'nested too deeply'),
        ('a' * 5000 + '\n', "read 'aaaa"),
    ],
)
def test_what_is_wrong_is_said_in_one_short_line(tmp_path, text, words):
    path = tmp_path / 'unkind.yaml'
    path.write_text(text)
    with pytest.raises(ScenarioError) as caught:
        read_layer(path)
    message = str(caught.value)
    assert words in message
    assert message.startswith(str(path)) and '\n' not in message
    assert len(message) < len(str(path)) + 250


def test_an_alias_that_is_used_twice_is_no_error(tmp_path):
    path = tmp_path / 'kind.yaml'
    path.write_text('a: &a [1, 2]\nb: [*a, *a]\n')
    assert read_layer(path).data == {'a': [1, 2], 'b': [[1, 2], [1, 2]]}
