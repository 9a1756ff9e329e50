"""Whatever comes over a line is numbers within bounds, or nothing."""

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.agent.drivers.arduino import parse_state
from mapweave.agent.drivers.koala import KOALA_2_5, SILVER, parse_numbers
from mapweave.agent.drivers.registry import find_driver
from mapweave.agent.drivers.settings import RobotSettings
from mapweave.agent.drivers.waveshare import parse_info
from mapweave.hybridmap.errors import SettingsError

ints = st.integers(-(2**31), 2**31)
# From 4300 digits on, Python refuses to make a number.
many_digits = st.builds(
    lambda digits, times: digits * times, st.text("0123456789", min_size=1), st.integers(4000, 5000)
)
noise = st.one_of(st.text(), st.text("0123456789,- _SE+.\ufffd"), many_digits)


@given(st.lists(ints, min_size=1, max_size=16))
def test_numbers_of_a_koala(numbers: list[int]):
    assert parse_numbers(",".join(map(str, numbers))) == numbers


@given(noise)
def test_noise_to_a_koala(text: str):
    numbers = parse_numbers(text)
    assert numbers is None or all(abs(n) < 10**10 for n in numbers)


@given(st.lists(st.integers(-(10**9), 10**9), min_size=16, max_size=16))
def test_distances_are_within_reach_or_missing(values: list[int]):
    for generation, count in ((SILVER, 16), (KOALA_2_5, 9)):
        reach = generation.geometry.ranger_reach
        assert reach is not None
        for distance in generation.distances(values[:count]):
            assert math.isnan(distance) or distance <= reach


@given(ints, ints, st.booleans(), st.lists(st.integers(-1, 999), max_size=8))
def test_a_state_of_an_arduino(left: int, right: int, bumped: bool, distances: list[int]):
    numbers = [left, right, int(bumped), *distances]
    assert parse_state("S " + " ".join(map(str, numbers))) == numbers


@given(st.one_of(noise, noise.map(lambda text: "S " + text)))
def test_noise_to_an_arduino(line: str):
    numbers = parse_state(line)
    assert numbers is None or (len(numbers) >= 3 and all(abs(n) < 10**10 for n in numbers))


json_values = st.recursive(
    st.one_of(st.none(), st.booleans(), st.floats(), st.integers(), st.text()),
    lambda inner: st.one_of(st.lists(inner), st.dictionaries(st.text(), inner)),
    max_leaves=10,
)


@given(st.dictionaries(st.sampled_from(["L", "R", "odl", "odr", "v"]), json_values))
def test_anything_that_a_waveshare_may_say(fields: dict[str, object]):
    info = parse_info(json.dumps({"T": 1001, **fields}))
    if info is not None:
        assert all(abs(speed) <= 5.0 for speed in info.speeds)
        assert info.odometers is None or all(math.isfinite(way) for way in info.odometers)


@given(noise)
def test_noise_to_a_waveshare(text: str):
    assert parse_info(text) is None


def test_what_a_waveshare_says():
    info = parse_info('{"T":1001,"L":0.1,"R":-0.2,"v":11.9,"odl":120,"odr":-30}')
    assert info is not None
    assert info.speeds == (0.1, -0.2)
    assert info.odometers == (1.2, -0.3)
    assert parse_info('{"T":1002,"L":0.1,"R":-0.2}') is None


@pytest.mark.parametrize(("driver", "options", "words"), [
    ("koala", {"prot": "x"}, r"\[robot.options\]: no setting 'prot'; did you mean 'port'"),
    ("create", {},
     r"\[robot.options\]: port is missing: write it in .* --robot FILE\.toml .*`mapweave find-port`"),
    ("arduino", {"port": "x"},
     r"wheel_radius is missing: write it in .* --robot FILE\.toml \(docs/drivers.md\)$"),
    ("arduino", {"port": "x", "wheel_radius": 0.0, "counts_per_turn": 1},
     "wheel_radius must be a number, above 0; it is 0.0"),
    ("arduino", {"port": "x", "wheel_radius": 1.0, "counts_per_turn": 1, "baud": 0},
     "baud must be a whole number, 50 to 10000000; it is 0"),
    ("waveshare", {"port": "x"}, r"no \[robot.camera\]"),
])  # fmt: skip
def test_options_that_cannot_be(driver: str, options: dict[str, object], words: str):
    with pytest.raises(SettingsError, match=words):
        find_driver(driver)(RobotSettings(options=options))
