"""A fleet to which everything happens that a scenario knows: afterwards nothing is lost, nothing is false."""

import pytest

from mapweave.agent.replication.journal import Journal
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.scenarios.run import TrialOptions, run_trial
from mapweave.scenarios.scenario import load_scenario

BAD_DAY = """
name = "bad-day"
robots = 2
[world]
kind = "office"
rooms = 3
[[events]]
at = 8.0
do = "worsen"
robot = "r0"
loss = 0.3
delay = 0.3
[[events]]
at = 11.0
do = "kill_server"
[[events]]
plus = 4.0
do = "start_server"
[[events]]
plus = 1.0
do = "cut"
robot = "r0"
[[events]]
plus = 1.0
do = "kill_agent"
robot = "r1"
[[events]]
plus = 2.0
do = "start_agent"
robot = "r1"
[[events]]
plus = 5.0
do = "restore"
robot = "r0"
[[events]]
plus = 1.0
do = "light"
factor = 0.7
[[events]]
after = "grown"
within = 40.0
do = "wait"
[expect]
maps = 2
unsaved_changes = 0
false_edges = 0
false_links = 0
troubles = 0
"""


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_bad_day(tmp_path):
    path = tmp_path / "bad-day.toml"
    path.write_text(BAD_DAY)
    options = TrialOptions(seed=3, out=tmp_path / "out", processes=False, film_every=5.0, quiet=True)
    trial = run_trial(load_scenario(path), options)
    assert [str(v) for v in trial.verdicts if not v.good] == []
    assert len(trial.recording.recoveries_s) == 3
    # The agent that was killed goes on with its map: one epoch, and nodes from after its return.
    journal = Journal(options.out / "agents" / "r1.sqlite", "r1")
    (only,) = journal.maps()
    stamps = [change.stamp_ns for change in journal.changes(only, 1, journal.head(only))]
    killed = next(m.stamp_ns for m in trial.recording.moments if "r1 is killed" in m.text)
    assert min(stamps) < killed < max(stamps)
    # What the journal has the store has, in the same order: counted here without the trial's own count.
    store = SqliteStore(options.out / "server" / "s0.sqlite")
    for item in (journal.maps()[0],):
        assert [c.sequence for c in store.replay(item)] == list(range(1, journal.head(item) + 1))
    journal.close()
    store.close()
    for name in ("film.webm", "report.md", "figures.json", "map.png", "r0.truth.tum"):
        assert (options.out / name).stat().st_size > 500


@pytest.mark.slow
def test_another_trial_takes_the_place_of_the_first_and_touches_nothing_else(tmp_path):
    path = tmp_path / "short.toml"
    path.write_text('robots = 1\n[world]\nkind = "arena"\n[[events]]\nat = 1.0\ndo = "wait"\n')
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("keep me")
    options = TrialOptions(seed=1, out=out, processes=False, film_every=0.0, quiet=True)
    first = run_trial(load_scenario(path), options)
    again = run_trial(load_scenario(path), options)
    assert (out / "mine.txt").read_text() == "keep me"
    assert first.figures.map_hash == again.figures.map_hash
    assert again.figures.sim_s == 1.0


def test_folders_of_others_are_not_taken_away(tmp_path):
    from mapweave.hybridmap.errors import SettingsError

    path = tmp_path / "short.toml"
    path.write_text('robots = 1\n[[events]]\nat = 1.0\ndo = "wait"\n')
    theirs = tmp_path / "out" / "agents"
    theirs.mkdir(parents=True)
    options = TrialOptions(seed=1, out=tmp_path / "out", processes=False, quiet=True)
    with pytest.raises(SettingsError, match="made by no earlier trial"):
        run_trial(load_scenario(path), options)
    assert theirs.is_dir()
