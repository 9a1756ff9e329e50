"""Settings: TOML over defaults, and one line for each error."""

import dataclasses
import re
import time
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mapweave.agent.drivers.settings_writer import write_camera
from mapweave.hybridmap.errors import SettingsError
from mapweave.settings import Settings, load_settings, settings_from
from mapweave.storage.settings_file import build, read_toml
from tests.programs import python


def load(tmp_path: Path, text: str | bytes) -> Settings:
    path = tmp_path / "robot.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_settings(path)


def refused(tmp_path: Path, text: str | bytes) -> str:
    """The single line."""
    with pytest.raises(SettingsError) as error:
        load(tmp_path, text)
    output = str(error.value)
    assert "\n" not in output
    assert output.startswith(str(tmp_path / "robot.toml"))
    return output


def test_without_a_file_all_is_default(tmp_path):
    assert load_settings(None) == Settings() == load(tmp_path, "")


def test_given_values_replace_the_defaults(tmp_path):
    given_settings = load(
        tmp_path,
        """
        [network]
        endpoints = ["tcp/10.0.0.1:7447", "tcp/10.0.0.2:7447"]
        [agent]
        seed = 7
        [agent.navigation]
        speed = 1
        [agent.tracking]
        filtered = 20
        """,
    )
    default = Settings()
    agent = default.agent
    expected = Settings(
        network=dataclasses.replace(default.network, endpoints=("tcp/10.0.0.1:7447", "tcp/10.0.0.2:7447")),
        agent=dataclasses.replace(
            agent,
            seed=7,
            navigation=dataclasses.replace(agent.navigation, speed=1.0),
            tracking=dataclasses.replace(agent.tracking, filtered=20),
        ),
    )
    assert given_settings == expected
    assert type(given_settings.agent.navigation.speed) is float


def as_toml(values: dict[str, Any], name: str = "") -> str:
    """Plain tables as TOML, written by hand."""
    plain, tables = [], []
    for key, value in values.items():
        if isinstance(value, dict):
            tables.append(as_toml(value, f"{name}.{key}" if name else key))
        elif value is not None:
            text = (
                list(value) if isinstance(value, tuple) else str(value) if isinstance(value, str) else value
            )
            plain.append(f"{key} = {str(text).lower() if isinstance(text, bool) else repr(text)}")
    return "\n".join([f"[{name}]" if name else "", *plain, *tables])


def test_every_setting_there_is_can_be_written_down(tmp_path):
    """All defaults as a file give the defaults: no setting has a kind that a file cannot name."""
    assert load(tmp_path, as_toml(dataclasses.asdict(Settings()))) == Settings()


@pytest.mark.parametrize(("text", "said"), [
    ("[netwrok]", "no setting 'netwrok'; did you mean 'network'?"),
    ("[network]\nendpoint = []", "network: no setting 'endpoint'; did you mean 'endpoints'?"),
    ("[agent.exploration]\ntravel_sped = 1",
     "agent.exploration: no setting 'travel_sped'; did you mean 'travel_speed'?"),
    ("[network]\nzzz = 1", "no setting 'zzz'; known are fleet, endpoints, routers, server"),
    ("network = 3", "network: expected table, got int; it is 3"),
    ("agent = []", "agent: expected table, got list"),
    ("[network]\nfleet = 3", "network.fleet: expected str, got int; it is 3"),
    ("[network]\nendpoints = 'tcp/1.2.3.4:5'", "network.endpoints: expected list, got str"),
    ("[network]\nendpoints = ['tcp/1.2.3.4:5', 7447]", "network.endpoints[1]: expected str, got int"),
    ("[agent]\nseed = 1.5", "agent.seed: expected int, got float; it is 1.5"),
    ("[agent]\nseed = true", "agent.seed: expected int, got bool; it is True"),
    ("[agent.navigation]\nspeed = 'far'", "agent.navigation.speed: expected float, got str; it is 'far'"),
    ("[agent.navigation]\nspeed = false", "agent.navigation.speed: expected float, got bool"),
    ("[agent.navigation]\nspeed = nan", "agent.navigation.speed: nan is no float"),
    ("[agent.navigation]\nspeed = inf", "agent.navigation.speed: inf is no float"),
    ("[agent.navigation]\nspeed = 0", "agent.navigation.speed must be a number, above 0; it is 0"),
    ("[agent.navigation]\nspeed = -0.2", "agent.navigation.speed must be a number, above 0; it is -0.2"),
    (f"[agent.navigation]\nspeed = 1{'0' * 400}", "agent.navigation.speed: the number has too many digits"),
    ("[agent.navigation]\nspeed = [1]", "agent.navigation.speed: expected float, got list"),
    ("[agent.tracking]\nfiltered = 2", "agent.tracking.filtered must be a whole number, 4 or more; it is 2"),
    ("[robot.camera]\ndelay = 5.5", "robot.camera.delay must be a number, 0 to 5; it is 5.5"),
    ("[admission_control]\nworkers = 65",
     "admission_control.workers must be a whole number, 0 to 64; it is 65"),
    ("[agent.landmarks]\nmost_bytes = 100", "robot.toml: most_bytes: a node needs 660 at least, not 100"),
    ("[merge]\nexclusions = 9.0", "merge: no setting 'exclusions'; did you mean 'exclusion'?"),
    ("[merge.exclusion]\ndoubt = 'much'", "merge.exclusion.doubt: expected float, got str"),
    ("[merge.consistency]\nleast_links = 1.5", "merge.consistency.least_links: expected int, got float"),
    ("[network", "robot.toml: last line: is not TOML: Expected ']'"),
    ("a = 1\na = 2", "robot.toml: last line: is not TOML: Cannot overwrite a value; correct it there"),
    ("\n[robot]\ndriver = koala",
     "robot.toml: line 3, column 10: is not TOML: Invalid value; correct it there"),
    (b"\xff\xfe", "robot.toml: is not text in UTF-8"),
    ("when = 1979-05-27", "no setting 'when'"),
    ("[agent]\nseed = 1979-05-27", "agent.seed: expected int"),
])  # fmt: skip
def test_errors_are_reported_in_one_line(tmp_path, text, said):
    assert said in refused(tmp_path, text)


def test_a_robot_reads_the_file_without_the_merges_libraries():
    """gtsam, faiss and scipy are the server's; a robot may not have them."""
    code = (
        "import sys; from mapweave.settings import load_settings; load_settings(None); "
        "sys.exit(', '.join({'gtsam', 'faiss', 'scipy'} & sys.modules.keys()) or None)"
    )
    python("-c", code, check=True)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(SettingsError, match=r"nothing\.toml: no such file$"):
        load_settings(tmp_path / "nothing.toml")
    with pytest.raises(SettingsError) as error:
        load_settings(tmp_path)
    assert "\n" not in str(error.value)


@dataclasses.dataclass(frozen=True)
class Strict:
    """Settings that refuse by themselves."""

    share: float = 0.5
    name: str | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.share <= 1:
            raise ValueError(f"share {self.share} is not in 0..1")


def test_errors_of_a_part_name_its_place():
    assert build(Strict, {"share": 1, "name": "x"}, "here") == Strict(1.0, "x")
    with pytest.raises(SettingsError, match=r"^here: share 2\.0 is not in 0\.\.1$"):
        build(Strict, {"share": 2}, "here")
    with pytest.raises(SettingsError, match=r"^here: name: expected str \| null, got int; it is 3$"):
        build(Strict, {"name": 3}, "here")


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


@settings(max_examples=80, suppress_health_check=[HealthCheck.too_slow])
@given(st.data())
def test_any_value_anywhere_is_taken_or_refused(data):
    """A walk down the settings to any one of them, then anything as its value."""
    cls, path = Settings, []
    while dataclasses.is_dataclass(cls):
        field = data.draw(st.sampled_from(dataclasses.fields(cls)))
        path.append(field.name)
        default = getattr(cls(), field.name)
        cls = type(default)
        if data.draw(st.integers(0, 9)) == 0:
            break
    value = data.draw(values)
    table: Any = value
    for name in reversed(path):
        table = {name: table}
    try:
        made: Any = settings_from(table, "file")
    except SettingsError as error:
        assert str(error).startswith("file: ")
        assert "\n" not in str(error)
        return
    for name in path:
        made = getattr(made, name)
    assert default is None or type(made) is type(default)
    if isinstance(default, tuple):
        assert str(field.type) == "tuple[str, ...]" and all(type(one) is str for one in made)


@pytest.mark.parametrize(("table", "words"), [
    ({"agent": {"landmarks": {"most_bytes": 0}}}, "file: most_bytes: a node needs 660 at least, not 0"),
    ({"robot": {"geometry": {"axle": 400.0}}}, "file: geometry: axle is 400; it is in metres, at most"),
])  # fmt: skip
def test_what_settings_refuse_themselves_names_the_file(table, words):
    with pytest.raises(SettingsError, match=f"^{re.escape(words)}"):
        settings_from(table, "file")


def test_a_camera_is_written_into_a_file_of_an_editor_of_windows(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_bytes(b'\xef\xbb\xbf[robot.camera]\r\nsource = "1"\r\n')
    write_camera(path, {"fx": 300.0})
    assert read_toml(path)["robot"]["camera"] == {"source": "1", "fx": 300.0}


def test_a_key_of_thousands_of_parts_is_refused_at_once(tmp_path):
    """The parser takes a time that grows with their square."""
    for key in (
        ".".join(["a"] * 8000),
        " . ".join(["a", '"b.c"', "'d'"] * 3000),
        f"[{'.'.join(['a'] * 64)}]",
    ):
        began = time.monotonic()
        assert "a key has 64 parts" in refused(tmp_path, f"x = 1\n{key} = 1" if "[" not in key else key)
        assert time.monotonic() - began < 0.5
    many = ", ".join(f"{number}.5" for number in range(500))
    (tmp_path / "numbers.toml").write_text(f"a.{'.'.join('b' * 62)} = [{many}]\nname = {'a.' * 40!r}")
    assert len(read_toml(tmp_path / "numbers.toml")) == 2
