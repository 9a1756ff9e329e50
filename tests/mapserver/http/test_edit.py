"""Editing on the page in a real browser, by mouse and keyboard, with a real map server behind."""

from contextlib import ExitStack
from datetime import datetime

import cv2
import numpy as np
import pytest

from mapweave.hybridmap.annotation import Closure, Floor, Place, Preference
from mapweave.hybridmap.area import inside
from mapweave.hybridmap.constraint_subject import Apart, Linked, RetiredArea, RetiredMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pin import Pin
from mapweave.hybridmap.portal import Portal, PortalMeans
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.wall_time import utc_words
from mapweave.mapserver.http.web import Web
from mapweave.mapserver.map_files import map_file_of
from mapweave.mapserver.server import MapServer
from mapweave.merge.settings import MergeSettings
from mapweave.opened_map import open_map
from mapweave.read_only_server import ReadOnlyServer
from mapweave.storage.map_file import write_map_file
from tests.browser import PROGRAMS, Browser, there_is_none
from tests.mapserver.http.person import annotation, last, opened
from tests.mapserver.test_corrections import FIRST, LAST, TRUE, A, B
from tests.waiting import eventually, free_port

pytestmark = pytest.mark.skipif(there_is_none(), reason=f"needs {' and '.join(PROGRAMS)} on the PATH")
SCALE = 0.02
PLAN_FROM_MERGED = Pose2(4.0, 4.0, 0.4)


@pytest.mark.slow
def test_the_map_is_corrected_on_the_page(browser: Browser, server: MapServer, tmp_path):
    port, stack = free_port(), ExitStack()
    stack.enter_context(Web(("127.0.0.1", port), server))
    person = opened(browser, port)
    person.fill("edit-name", "anna")
    # By keyboard: the first node of each of two components.
    first, *_, other = browser.run("return mapweave.model.order.map(row => mapweave.model.name(row))")
    browser.run("document.getElementById('canvas').focus()")
    for key in ("n", " ", "p", " "):
        person.key(key, key)
    eventually(lambda: browser.run("return mapweave.selection.names") == [first, other])
    assert "joins component 0 (3 nodes) and component 1 (3 nodes)" in person.text("edit-counts")
    # The images do not agree: that is refused with the figures, and a pose by hand offered.
    refusal = person.edit("link", "one door")
    assert "do not show one place" in refusal and "10 are needed" in refusal
    assert "--" not in refusal and "mapweave" not in refusal, "words of the shell mean nothing on a page"
    assert browser.run("return document.getElementById('edit-name').checkVisibility()")
    assert browser.run("return document.querySelector('#edit-kinds details').open")
    assert browser.run("return document.getElementById('edit-because').value") == "one door"
    assert browser.run("return document.getElementById('edit-apply').disabled")
    said = person.edit("link", "one door", x=1.5, y=0, deg=30)
    assert "only checked, nothing is changed" in said and "by hand alone" in said
    assert not server.constraints().made
    assert "linked by hand by anna" in person.apply()
    assert isinstance(last(server), Linked) and last(server).pose == Pose2(1.5, 0.0, np.radians(30.0))
    # Each change is waited for on the page: what is drawn moves with it.
    eventually(lambda: browser.run("return mapweave.model.links.length") == 1)
    person.take_back(server)
    assert not server.constraints().made[-1].holds
    # By mouse: shift and click on the map, a click in the form.
    assert server.settle(60.0)
    eventually(lambda: browser.run("return mapweave.model.links.length") == 0)
    person.press("tab-fleet")
    person.press("edit-clear")
    person.press("fit")
    person.mouse(person.at(LAST), modifiers=8)
    eventually(lambda: browser.run("return !document.getElementById('edit').hidden"))
    person.mouse(person.at(FIRST))
    assert browser.run("return mapweave.selection.names") == [str(LAST), str(FIRST)]
    for name in ("x", "y", "deg"):
        person.fill(f"edit-link-{name}", "")
    assert "of the images agree on one pose" in person.edit("link", "the images show it")
    person.apply()
    assert last(server).a_from_b.mean.distance(TRUE) < 0.1
    assert server.settle(60.0) and len(server.merged().links) == 1
    eventually(lambda: browser.run("return mapweave.model.links.length") == 1)
    person.fill("edit-nodes", f"{LAST} {FIRST}")
    assert "1 link is undone" in person.edit("unmerge", "two halls", scope="maps")
    person.apply()
    assert last(server) == Apart((A, B))
    eventually(lambda: browser.run("return mapweave.model.links.length") == 0)
    person.take_back(server)
    assert server.settle(60.0) and len(server.merged().links) == 1
    eventually(lambda: browser.run("return mapweave.model.links.length") == 1)

    # An area by dragging: its nodes are those that an independent test finds in it.
    (x, y), (u, v) = person.at(LAST), person.at(FIRST)
    person.press("draw-rectangle")
    person.mouse((min(x, u) - 9, min(y, v) - 9), (x, y), (max(x, u) + 9, max(y, v) + 9))
    area = browser.run("return mapweave.selection.area")
    merged = server.merged()
    anchor = NodeId.parse(area["anchor"])
    places = merged.graphs[merged.component_of(anchor)].means[:, :2]
    within = int(inside(np.array(area["corners"]), merged.pose(anchor).inverse().apply(places)).sum())
    assert 2 <= within < 6 and f": {within} nodes of a.1, b.1" in person.text("edit-counts")
    assert f"{within} nodes in it" in person.edit("place", "where they meet", name="hall")
    person.apply()
    assert annotation(server).name == "hall" and isinstance(annotation(server).body, Place)
    assert annotation(server).who == "anna" and annotation(server).because == "where they meet"
    assert f"; {within} nodes of a.1, b.1" in person.edit("retire", "wet paint", scope="selected")
    person.apply()
    assert isinstance(last(server), RetiredArea) and server.settle(60.0)
    eventually(lambda: browser.run("return mapweave.model.order.length") == 6 - within)
    person.take_back(server)
    eventually(lambda: browser.run("return mapweave.model.order.length") == 6)

    # A polygon by keyboard: a corner in the middle of the map by Enter.
    person.press("edit-clear")
    browser.run(f"const m = mapweave.model; m.at = m.rowOf('{LAST}');")
    person.press("draw-polygon")
    browser.run("document.getElementById('canvas').focus()")
    for dx, dy in ((-0.5, -0.5), (0.5, -0.5), (0.0, 0.7)):
        browser.run(
            f"mapweave.viewport.show(mapweave.model.x[mapweave.model.at] + {dx},"
            f" mapweave.model.y[mapweave.model.at] + {dy})"
        )
        person.key("Enter")
    person.press("draw-finish")
    eventually(lambda: browser.run("return mapweave.selection.area?.corners.length") == 3)

    # Whatever else is said about it; a name that is used again shows what it replaces, and comes back.
    assert "it takes the place of: place hall is an area" in person.edit("place", "it is here", name="hall")
    person.apply()
    person.take_back(server)
    halls = [one.body for one in server.annotations().made if one.name == "hall"]
    assert len(halls) == 3 and halls[2] == halls[0] != halls[1]
    assert "Give the area a name" in person.edit("closure", "wet floor")
    said = person.edit("closure", "wet floor", name="paint", begin="2031-03-01T12:00", end="2031-03-01T18:30")
    assert "of robots" in said
    person.apply()
    closure = annotation(server).body
    zone = datetime(2031, 3, 1, 12).astimezone()
    assert isinstance(closure, Closure) and closure.begin_ns == int(zone.timestamp()) * 10**9
    assert closure.end_ns == closure.begin_ns + int(6.5 * 3600) * 10**9
    person.fill("edit-nodes", f"{A}.1 {LAST}")
    assert f"no edge joins {A}.1 and {LAST}" in person.edit("preference", "carpet", factor=0.5)
    person.fill("edit-nodes", f"{A}.3 {LAST}")
    person.edit("preference", "carpet", factor=0.5)
    person.apply()
    assert annotation(server).body == Preference(0.5, (NodeId(*A, 3), LAST))
    # In the list with their figures: a closure that does not hold yet must not look like one that does.
    between = f"from {utc_words(closure.begin_ns)} until {utc_words(closure.end_ns)}"
    eventually(lambda: f"paint closure {between}" in person.text("places"))
    eventually(lambda: f"{A}.3 {LAST} preferred: cost times 0.5" in person.text("places"))
    person.fill("edit-nodes", str(FIRST))
    person.edit("floor", "upstairs", label="upper")
    person.apply()
    assert annotation(server).body == Floor(FIRST, "upper") and annotation(server).name == str(B)
    person.fill("edit-nodes", f"{LAST} {FIRST}")
    assert "a lift leads to another floor" in person.edit(
        "portal", "the only way up", name="east lift", means="lift"
    )
    said = person.edit("portal", "it is locked", name="east door", means="door", note="key at the desk")
    assert "only checked, nothing is changed: portal east door" in said
    person.apply()
    assert annotation(server).body == Portal(LAST, FIRST, PortalMeans.DOOR, "key at the desk")
    person.fill("edit-nodes", str(FIRST))
    person.edit("pin", "the door is here")
    person.apply()
    held = annotation(server).body
    assert isinstance(held, Pin) and held.merged_from_node == server.merged().pose(FIRST)
    assert "has x, y and a heading" in person.edit("pin", "the door is here", x=3)
    person.edit("pin", "the door is here", x=3, y=-2, deg=90)
    person.apply()
    assert annotation(server).body == Pin(FIRST, Pose2(3.0, -2.0, np.pi / 2.0))
    person.edit("retire", "test drive", scope="map")
    person.apply()
    assert last(server) == RetiredMap(B)

    # Nothing is lost, and nothing can be changed, while the server is gone; a map file is never changed.
    stack.close()
    eventually(lambda: "does not answer" in person.text("edit-refused"))
    assert browser.run("return document.getElementById('edit-because').matches(':disabled')")
    assert browser.run("return document.getElementById('edit-because').value") == "test drive"
    path = tmp_path / "merged.mapweave"
    write_map_file(path, map_file_of(merged))
    one = open_map(path)
    with ReadOnlyServer(one, one.merged(MergeSettings())) as file, Web(("127.0.0.1", port), file):
        eventually(lambda: "is only shown" in person.text("edit-refused"), seconds=60)
        assert browser.run("return document.getElementById('edit-check').matches(':disabled')")
    refused = [words for words in browser.errors() if "net::ERR_" not in words]
    assert all("400" in words or "WebSocket" in words for words in refused), refused


@pytest.mark.slow
def test_a_plan_is_laid_under_the_map_on_the_page(browser: Browser, server: MapServer, tmp_path):
    poses = {node: server.merged().pose(node) for node in server.merged().components[0]}
    (tmp_path / "map.yaml").write_text(
        f"image: hall.pgm\nresolution: {SCALE}\norigin: [0, 0, 0]\nnegate: 1\n"
    )
    cv2.imwrite(str(tmp_path / "hall.pgm"), np.full((400, 500), 40, np.uint8))
    with Web(("127.0.0.1", 0), server) as web:
        person = opened(browser, web.port)
        person.fill("edit-kind", "plan")
        browser.devtools("Network.enable")
        browser.devtools("Network.setBlockedURLs", urls=["*/plan-images/*"])
        browser.type("#plan-file", f"{tmp_path / 'map.yaml'}\n{tmp_path / 'hall.pgm'}")
        # Its size is known before its pixels come, here only at the second try.
        eventually(lambda: browser.run("return mapweave.planEditor.image?.width") == 500)
        assert browser.run("return document.getElementById('plan-scale').value") == str(SCALE)

        def pair(node: NodeId, x: float, y: float, off: float = 0.0) -> None:
            """Click its pixel on the plan, then the place on the map; x and y are in the merged map, m."""
            u, up = PLAN_FROM_MERGED.apply(np.array([x, y])) / SCALE
            here = browser.run(
                "const v = mapweave.planEditor.pane.viewport, box = document.getElementById('plan-canvas')"
                f".getBoundingClientRect(), [u, w] = v.toScreen({u + off / SCALE}, {-(400.0 - up)});"
                "return [box.left + u, box.top + w]"
            )
            person.mouse(tuple(here))
            assert "Now click the same place on the map" in person.text("plan-next")
            there = browser.run(
                "const m = mapweave.model, box = mapweave.painter.canvas.getBoundingClientRect(),"
                f"[dx, dy] = m.offset(0), [u, w] = mapweave.viewport.toScreen({x} + dx, {y} + dy);"
                "return [box.left + u, box.top + w]"
            )
            person.mouse(tuple(there))

        # With the keyboard Enter clicks the middle of the plan; another click takes its place.
        browser.run("document.getElementById('plan-canvas').focus()")
        person.key("Enter")
        eventually(lambda: browser.run("return mapweave.planEditor.pixel?.u") == 250)
        browser.devtools("Network.setBlockedURLs", urls=[])
        # What is most there, since a pair may be marked anywhere.
        paper = (
            "const canvas = document.getElementById('plan-canvas'), c = canvas.getContext('2d');"
            "const data = c.getImageData(canvas.width / 2, canvas.height / 2, 60, 60).data, counts = {};"
            "for (let k = 0; k < data.length; k += 4) counts[data[k]] = (counts[data[k]] ?? 0) + 1;"
            "return Number(Object.keys(counts).reduce((a, b) => (counts[a] > counts[b] ? a : b)))"
        )
        eventually(lambda: browser.run(paper) == 215)
        # A click beside the plan is none.
        corner = "const box = document.getElementById('plan-canvas').getBoundingClientRect();"
        person.mouse(tuple(browser.run(f"{corner} return [box.left + 3, box.top + 3]")))
        assert "beside the plan" in person.text("plan-next")
        assert browser.run("return mapweave.planEditor.pixel?.u") == 250
        person.press("fit")
        browser.run("mapweave.viewport.zoom(0.3)")
        node, pose = next(iter(poses.items()))
        pair(node, pose.x, pose.y)
        for dx, dy in ((2.0, 0.0), (0.0, 2.0), (-2.0, -1.5), (1.5, -2.0)):
            pair(node, pose.x + dx, pose.y + dy)
        pair(node, pose.x - 2.0, pose.y + 1.0, off=0.9)
        # The first is the node itself; residuals come by themselves, and say which pair is wrong.
        pairs = browser.run("return mapweave.planEditor.pairs")
        assert len(pairs) == 6 and (pairs[0]["node"], pairs[0]["x"], pairs[0]["y"]) == (str(node), 0, 0)
        eventually(lambda: "pair 6" in person.text("plan-fit"))
        assert "most probably wrong" in person.text("plan-fit") and not server.annotations().made
        browser.run("[...document.querySelectorAll('#plan-pairs button')].at(-1).click()")
        eventually(lambda: "m/px as given" in person.text("plan-fit"))
        assert "wrong" not in person.text("plan-fit")
        assert browser.run("return document.querySelectorAll('#plan-pairs span').length") == 5
        # It is drawn under the map before it is kept, as faint as the slider says.
        for share, ink in ((100, 215), (0, None)):
            person.fill("opacity", share)
            grey = "return mapweave.painter.canvas.getContext('2d').getImageData({}, {}, 1, 1).data[0]"
            x, y = (round(v) for v in person.at(node))
            box = browser.run("return mapweave.painter.canvas.getBoundingClientRect().left")
            pixel = grey.format(round(x - box) + 25, y - 49 + 25)
            eventually(lambda pixel=pixel, ink=ink: (browser.run(pixel) == 215) == (ink is not None))
        # In the dark theme, whose colours could not be read on white paper, black and white are exchanged.
        # The map is drawn all the time, as while robots drive: a frame must not hide that the theme changes.
        person.fill("opacity", 100)
        browser.run(
            "const go = () => { window.again = requestAnimationFrame(go); mapweave.painter.ask() }; go()"
        )
        browser.look(1280, 800, "dark")
        eventually(lambda: browser.run(pixel) == 255 - 215)
        # As in the pane beside it.
        eventually(lambda: browser.run(paper) == 255 - 215)
        browser.look(1280, 800)
        eventually(lambda: browser.run(paper) == 215 == browser.run(pixel))
        browser.run("cancelAnimationFrame(window.again)")
        person.fill("plan-because", "by the architect")
        person.press("plan-save")
        eventually(lambda: "plan map is hall.pgm, 5 pairs" in person.text("plan-answer"))
        placed = server.plans().plan("map").part()
        assert np.allclose(placed.plan_from_merged.vector, PLAN_FROM_MERGED.vector, atol=0.05)
        eventually(lambda: browser.run("return document.getElementById('plan-choice').value") == "map")
        # Another time it is opened, changed and deleted.
        browser.open(f"http://127.0.0.1:{web.port}/")
        eventually(lambda: "map" in person.text("plan-choice"))
        person.press("tab-edit")
        person.fill("edit-kind", "plan")
        person.fill("plan-choice", "map")
        eventually(lambda: "m/px as given" in person.text("plan-fit"))
        # Back to a scale that is kept already: it fits as before, and is still drawn.
        for scale in (str(1.01 * SCALE), str(SCALE)):
            person.fill("plan-scale", scale)
            eventually(lambda: "m/px as given" in person.text("plan-fit"))
        assert "known already" not in person.text("plan-fit")
        assert browser.run("return mapweave.planEditor.fit.parts.length") == 1
        browser.run("document.querySelector('#plan-pairs button').click()")
        eventually(lambda: browser.run("return document.querySelectorAll('#plan-pairs span').length") == 4)
        person.fill("plan-because", "a door that was moved")
        person.press("plan-save")
        eventually(lambda: "4 pairs" in person.text("plan-answer"))
        person.fill("plan-because", "it is rebuilt")
        person.press("plan-delete")
        eventually(lambda: "withdrawn" in person.text("plan-answer"))
        assert server.plans().plans == () and annotation(server).because == "it is rebuilt"
        person.take_back(server)
        assert len(server.plans().plan("map").plan.pairs) == 4
