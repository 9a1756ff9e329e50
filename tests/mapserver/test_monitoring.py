"""The board, the alerts and the page: they name metrics and labels that a real scrape has, and no others."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import promql_parser as promql
import pytest
from prometheus_client.parser import text_string_to_metric_families
from ruamel.yaml import YAML

from mapweave.hybridmap.agent_status import AgentStatus, Status
from mapweave.hybridmap.pose import Pose2
from mapweave.wire.messages import encode
from tests.mapserver.test_set_apart import KEYS, Fleet, serving
from tests.waiting import eventually

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "examples" / "monitoring"
ADDED = {"instance", "job"}
"""Labels that Prometheus itself adds."""
UP = {"up": ADDED}
"""And the metric."""


@pytest.fixture(scope="module")
def labels(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, set[str]]]:
    """The labels of each series of a server with a robot, by name."""
    with serving(tmp_path_factory.mktemp("server") / "s0.sqlite") as fleet:
        status = AgentStatus(Status("mapping", "", 0, 0, Pose2(), False), 1, "r0", 1)
        fleet.bus.publish(KEYS.agent_status("r0"), encode(status))
        eventually(lambda: b'robot="r0"' in fleet.server.metrics())
        yield series(fleet)


def series(fleet: Fleet) -> dict[str, set[str]]:
    return {
        sample.name: {*sample.labels}
        for family in text_string_to_metric_families(fleet.server.metrics().decode())
        for sample in family.samples
    }


def check(query: str, labels: dict[str, set[str]]) -> set[str]:
    """Fail if a query asks for what is not there; the labels of all that it asks for."""
    asked: set[str] = set()

    def visit(part: promql.Expr) -> None:
        if isinstance(part, promql.VectorSelector):
            assert part.name in labels | UP, f"{part.name} of {query}"
            here = (labels | UP)[part.name] | ADDED
            assert {matcher.name for matcher in part.matchers.matchers} <= here, query
            asked.update(here)

    expression = promql.parse(query)
    promql.walk(expression, visit)
    assert asked, f"{query} asks for nothing"
    grouped = re.findall(r"\b(?:by|on) ?\(([^)]*)\)", expression.prettify())
    assert {label.strip() for group in grouped for label in group.split(",")} <= asked, query
    return asked


def test_every_panel_of_the_board_asks_for_what_is_there(labels: dict[str, set[str]]):
    board = json.loads((FOLDER / "grafana.json").read_text())
    panels = [panel for panel in board["panels"] if panel["type"] != "row"]
    assert len(panels) > 15
    for panel in panels:
        assert panel["targets"] and panel["title"]
        for target in panel["targets"]:
            assert '{instance="$instance"' in target["expr"], "the board shows one server"
            there = check(target["expr"], labels)
            assert {*re.findall(r"{{(\w+)}}", target["legendFormat"])} <= there, panel["title"]
    places = [panel["gridPos"] for panel in board["panels"]]
    taken = {
        (x, y) for p in places for x in range(p["x"], p["x"] + p["w"]) for y in range(p["y"], p["y"] + p["h"])
    }
    assert len(taken) == sum(p["w"] * p["h"] for p in places), "no panel lies over another"
    assert all(p["x"] + p["w"] <= 24 for p in places)
    (variable,) = (v for v in board["templating"]["list"] if v["name"] == "instance")
    name = re.fullmatch(r"label_values\((\w+), instance\)", variable["query"]["query"])
    assert name and name[1] in labels
    assert len({panel["id"] for panel in board["panels"]}) == len(board["panels"])


def test_whatever_an_alert_watches_is_on_the_board():
    """`MapweaveMapOld` came, and no panel showed for how long changes had waited."""
    board, alerts = ((FOLDER / name).read_text() for name in ("grafana.json", "alerts.yml"))
    watched = {*re.findall(r"\bmapweave_\w+", "\n".join(re.findall("expr:.*", alerts)))}
    assert len(watched) > 8
    assert watched <= {*re.findall(r"\bmapweave_\w+", board)}


def test_every_alert_asks_for_what_is_there(labels: dict[str, set[str]]):
    (group,) = YAML(typ="safe").load(FOLDER / "alerts.yml")["groups"]
    assert {"MapweaveRobotLagging", "MapweaveGap", "MapweaveStoreFailing"} <= {
        r["alert"] for r in group["rules"]
    }
    for rule in group["rules"]:
        there = check(rule["expr"], labels)
        words = rule["annotations"]["summary"]
        assert {*re.findall(r"\$labels\.(\w+)", words)} <= there, rule["alert"]
        assert words.count("{{") == words.count("}}")
        assert rule["labels"]["severity"] in ("warning", "critical")
        promql.parse_duration(rule["for"])


def test_the_scrape_goes_where_http_serves():
    config: dict[str, Any] = YAML(typ="safe").load(FOLDER / "prometheus.yml")
    (job,) = config["scrape_configs"]
    assert job["job_name"] == "mapweave" and job["scheme"] == "https"
    assert job.get("metrics_path", "/metrics") == "/metrics"
    assert config["rule_files"] == ["alerts.yml"]


def test_the_page_lists_every_metric(labels: dict[str, set[str]]):
    page = (ROOT / "docs" / "monitoring.md").read_text()
    listed = {
        name: {*re.findall(r"`(\w+)`", more)}
        for name, more in re.findall(r"^\| `(mapweave_(?!agent_)\w+)` \|([^|]*)\|", page, re.MULTILINE)
    }
    own = {
        re.sub(r"_(bucket|sum|count|created)$", "", name): there - {"le"}
        for name, there in labels.items()
        if name.startswith("mapweave_")
    }
    assert listed == own
