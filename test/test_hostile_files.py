"""No file that is handed in takes memory or time that it does not have, and each refusal is one
sentence."""

import struct
import tracemalloc
from pathlib import Path

import pytest

from bench.files.hostile_files import HOSTILE_YAML
from cutting_trainer.bags.cdr import Decoder
from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.message_class import message_class
from cutting_trainer.bags.message_text import SEPARATOR
from cutting_trainer.bags.metadata import read_metadata
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.bags.untrusted_yaml import load_yaml
from cutting_trainer.cli import main as cli
from cutting_trainer.haptic_bridge.scene_schema import DeviceProfile, SettingsError, ToolSettings
from cutting_trainer.node_common.errors import SceneError
from cutting_trainer.node_common.scene_reader import read_section
from cutting_trainer.tissue_sim.scene_schema import TissueSettings

pytestmark = pytest.mark.long

MAX_SENTENCE = 700
SAMPLE = Path(__file__).parents[1] / 'bags' / 'samples' / 'format_2' / 'palpation'


def bytes_of(text: str | bytes) -> bytes:
    return text if isinstance(text, bytes) else text.encode()


def one_sentence(said: str, path: Path) -> None:
    assert '\n' not in said and len(said) < MAX_SENTENCE, said
    assert str(path) in said, said


@pytest.mark.parametrize('kind', HOSTILE_YAML)
def test_a_hostile_scene_is_refused_in_one_sentence_with_its_file(
    tmp_path: Path, kind: str
) -> None:
    path = tmp_path / 'mine.yaml'
    path.write_bytes(bytes_of(HOSTILE_YAML[kind]))
    section, model = ('tissue', TissueSettings) if 'path' in kind else ('tool', ToolSettings)
    with pytest.raises(SceneError) as refused:
        read_section(path, section, model)
    one_sentence(str(refused.value), path)


@pytest.mark.parametrize('kind', HOSTILE_YAML)
def test_a_hostile_device_file_is_refused_in_one_sentence(tmp_path: Path, kind: str) -> None:
    path = tmp_path / 'mine.yaml'
    path.write_bytes(bytes_of(HOSTILE_YAML[kind]))
    with pytest.raises(SettingsError) as refused:
        DeviceProfile.load(path)
    one_sentence(str(refused.value), path)


@pytest.mark.parametrize('kind', HOSTILE_YAML)
def test_hostile_metadata_of_a_bag_is_refused_in_one_sentence(tmp_path: Path, kind: str) -> None:
    path = tmp_path / 'metadata.yaml'
    path.write_bytes(bytes_of(HOSTILE_YAML[kind]))
    with pytest.raises(BagError) as refused:
        read_metadata(tmp_path)
    one_sentence(str(refused.value), path)


@pytest.mark.parametrize('kind', ['aliases', 'lists 900 deep', 'blocks 900 deep'])
def test_the_command_line_says_the_line_and_ends_with_status_2(
    tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / 'mine.yaml'
    path.write_bytes(bytes_of(HOSTILE_YAML[kind]))
    with pytest.raises(SystemExit) as ended:
        cli.main(['plan', str(path)])
    said = capsys.readouterr().err.strip()
    assert ended.value.code == 2
    one_sentence(said, path)
    assert said.startswith(f'error: {path}:')


def test_values_that_aliases_repeat_are_counted_and_few_of_them_are_welcome() -> None:
    assert load_yaml('a: &a [1, 2]\nb: [*a, *a]', 'here') == {'a': [1, 2], 'b': [[1, 2], [1, 2]]}


def definition(own: str, *others: tuple[str, str]) -> str:
    """The text of a type and of those that it contains, as bags have it."""
    return '\n'.join([own, *(f'{SEPARATOR}\nMSG: {name}\n{body}' for name, body in others)])


CHAIN = [(f'p/T{n}', f'p/T{n + 1} x') for n in range(40)]
DEFINITIONS = {
    'a type that contains itself': (definition('p/A x', ('p/A', 'p/A x')), b''),
    'two that contain each other': (
        definition('p/A x', ('p/A', 'p/B x'), ('p/B', 'p/A x\np/A y')), b'',
    ),
    'forty within one another': (definition('p/T0 x', *CHAIN, ('p/T40', 'int8 x')), b''),
    'forty, the inner ones first': (
        definition('p/T30 y\np/T20 x\np/T0 z', *CHAIN, ('p/T40', 'int8 x')), b'',
    ),
    'two megabytes': ('int8 x\n' * 300_000, b''),
    'four billion empty structures': (definition('p/E[] x', ('p/E', '')), b'\xff' * 4),
    'a thousand million empty structures': (definition('p/E[1000000000] x', ('p/E', '')), b''),
    'two million structures that are there': (
        definition('p/E[] x', ('p/E', '')), struct.pack('<I', 1 << 21) + bytes(1 << 21),
    ),
    'an array of no elements': (definition('p/E[] x', ('p/E', 'int8[0] x')), b'\xff' * 4),
    'an array of a number without end': (f'int8[{"9" * 5000}] x', b''),
    'numbers beyond the end': ('float64[] x', b'\xff' * 4),
    'a string beyond the end': ('string x', b'\xff' * 4),
    'a type that is not defined': ('p/Nothing x', b''),
    'a name of 100 kB': (f'p/{"N" * 100_000} x', b''),
    'nothing at all': ('int32 x', b''),
}  # fmt: skip


@pytest.mark.parametrize('kind', DEFINITIONS)
def test_a_definition_or_message_without_end_is_refused_before_it_is_unpacked(kind: str) -> None:
    text, data = DEFINITIONS[kind]
    tracemalloc.start()
    try:
        with pytest.raises(BagError) as refused:
            Decoder({'p/msg/M': text}).decode('p/msg/M', b'\x00\x01\x00\x00' + data)
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert '\n' not in str(refused.value) and len(str(refused.value)) < MAX_SENTENCE
    assert most < 5e8


def test_a_field_that_a_definition_lacks_is_missing_in_one_sentence() -> None:
    message = Decoder({'p/msg/M': 'int8 x'}).decode('p/msg/M', b'\x00\x01\x00\x00\x07')
    assert message.x == 7 and not hasattr(message, 'y')
    with pytest.raises(BagError, match='no field y'):
        _ = message.y


@pytest.mark.parametrize(
    'name', ['os/msg/path', 'antigravity/msg/Fly', '../x/msg/T', 'std_msgs/msg/../T', 'x' * 10**6]
)
def test_no_module_is_imported_that_is_not_in_the_list(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        'cutting_trainer.bags.message_class.import_module', lambda name: pytest.fail(name)
    )
    with pytest.raises(BagError) as refused:
        message_class(name)
    assert len(str(refused.value)) < MAX_SENTENCE


def test_every_type_that_a_session_has_can_be_imported() -> None:
    assert {message_class(kind) for kind in open_bag(SAMPLE).topics().values()}
