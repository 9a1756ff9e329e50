"""Pictures of a mapping run: the paper's Figures 7 and 8 with the truth beside, landmarks, plan and view."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.mapping_run.scene import MappingDrive
from benchmarks.mapping_run.score import LastKnown, track_errors
from mapweave.hybridmap.pose import Array, wrap_angle

if TYPE_CHECKING:
    # It takes long to import, which tests that draw nothing do not wait for.
    from matplotlib.figure import Figure
    from matplotlib.patches import Ellipse

ESTIMATE, TRUTH, WHEELS, GREEN, PERSON = "#1f77b4", "#222222", "#d95f02", "#2a9d4b", "#f3d9d6"
COLOURS = ("#1f77b4", "#d95f02", "#2a9d4b", "#8e44ad", "#c0392b", "#16a0a0")
TRACK_LENGTH = 40
"""Ticks of a track that are drawn."""


def draw(run: MappingDrive, out: Path) -> tuple[Path, ...]:
    """Write all pictures of a run into a folder that is there; returns their names."""
    pictures = {
        "fig7.png": _draw_pose, "fig8.png": _draw_encoders, "landmarks.png": _draw_landmarks,
        "map.png": _draw_map, "view.png": _draw_view,
    }  # fmt: skip
    for name, picture in pictures.items():
        picture(run, out / name)
    return tuple(out / name for name in pictures)


@contextmanager
def _sheet(run: MappingDrive, title: str, path: Path, size: tuple[float, float]) -> Iterator[Figure]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"{run.name}: {title}", fontsize=11)
    yield figure
    figure.savefig(path, format="png")


def _draw_pose(run: MappingDrive, path: Path) -> None:
    """Figure 7: positions and orientation over time; below, the errors with what the filter expects."""
    t = run.seconds
    true = np.array([m.true.vector for m in run.moments])
    wheels = np.array([m.wheels.vector for m in run.moments])
    mean = np.array([m.pose.mean.vector for m in run.moments])
    sigmas = np.array([_sigmas_in_anchor(m.pose.covariance, m.pose.mean.heading) for m in run.moments])
    with _sheet(run, "the robot's pose since the anchor (Figure 7)", path, (13, 6.5)) as figure:
        axes = figure.subplots(2, 3, sharex=True, height_ratios=(2, 1))
        names = (("x ahead", "m", 1.0, "mm", 1e3), ("y left", "m", 1.0, "mm", 1e3),
                 ("heading", "deg", math.degrees(1.0), "deg", math.degrees(1.0)))  # fmt: skip
        for k, (name, unit, scale, small, finer) in enumerate(names):
            top, low = axes[0, k], axes[1, k]
            _shade(run, top)
            _shade(run, low)
            top.fill_between(t, *(scale * (mean[:, k] + s * sigmas[:, k]) for s in (-2, 2)), color=ESTIMATE,
                             alpha=0.25, linewidth=0, label="2 sigma")  # fmt: skip
            top.plot(t, scale * wheels[:, k], color=WHEELS, linewidth=1.0, label="wheels alone")
            top.plot(t, scale * mean[:, k], color=ESTIMATE, linewidth=1.4, label="estimate")
            top.plot(t, scale * true[:, k], color=TRUTH, linewidth=1.0, linestyle="--", label="truth")
            top.set_ylabel(f"{name}, {unit}")
            off, astray = mean[:, k] - true[:, k], wheels[:, k] - true[:, k]
            if k == 2:
                off, astray = (np.array([wrap_angle(a) for a in e]) for e in (off, astray))
            low.fill_between(t, -2 * finer * sigmas[:, k], 2 * finer * sigmas[:, k], color=ESTIMATE,
                             alpha=0.25, linewidth=0)  # fmt: skip
            low.plot(t, finer * astray, color=WHEELS, linewidth=0.9)
            low.plot(t, finer * off, color=ESTIMATE, linewidth=1.2)
            low.axhline(0.0, color=TRUTH, linewidth=0.6)
            low.set_ylabel(f"error, {small}")
            low.set_xlabel("time, s")
        figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=5,
                      frameon=False)  # fmt: skip


def _draw_encoders(run: MappingDrive, path: Path) -> None:
    """Figure 8: what the encoders say, and the integrals of the forward and the angular way."""
    t, half = run.seconds, 0.5 * run.robot.axle
    steps = np.array([[m.odometry.forward, m.odometry.turn] for m in run.moments])
    true = _true_steps(run)
    with _sheet(run, "what the wheels did (Figure 8)", path, (13, 6.5)) as figure:
        axes = figure.subplots(2, 2, sharex=True)
        for at in axes.flat:
            _shade(run, at)
        for name, sign, colour in (("left", -1.0, COLOURS[1]), ("right", 1.0, COLOURS[0])):
            way = 1e3 * (steps[:, 0] + sign * half * steps[:, 1])
            axes[0, 0].plot(t, way, color=colour, linewidth=0.9, label=name)
            axes[0, 1].plot(t, way.cumsum() / 1e3, color=colour, linewidth=1.2, label=name)
        axes[0, 0].set_ylabel("way of a wheel in a tick, mm")
        axes[0, 1].set_ylabel("way of a wheel, m")
        for at, column, scale, name in ((axes[1, 0], 0, 1.0, "forward way, m"),
                                        (axes[1, 1], 1, math.degrees(1.0), "angular way, deg")):  # fmt: skip
            at.plot(t, scale * steps[:, column].cumsum(), color=WHEELS, linewidth=1.2, label="encoders")
            at.plot(t, scale * true[:, column].cumsum(), "--", color=TRUTH, linewidth=1.0, label="truth")
            at.set_ylabel(name)
            at.set_xlabel("time, s")
        for at in axes.flat:
            at.legend(frameon=False, fontsize=8)


def _draw_landmarks(run: MappingDrive, path: Path) -> None:
    """The paper's state: coordinates of landmarks in the moving camera, and how they converge."""
    t, chosen = run.seconds, _choose(run, len(COLOURS))
    with _sheet(run, "landmarks in the moving camera, with 2 sigma; truth dashed", path, (13, 9)) as figure:
        axes = figure.subplots(3, 1, sharex=True)
        farthest = run.truth(np.array(chosen, np.int64))[0][:, 0].max(initial=1.0)
        for colour, track in zip(COLOURS, chosen, strict=False):
            believed, true = _history(run, track)
            depth, sigma, aside = believed.T
            with np.errstate(divide="ignore", invalid="ignore"):
                # The filter's belief is Gaussian in the inverse depth.
                w, spread = 1.0 / depth, sigma / depth**2
                near, far = 1.0 / (w + 2 * spread), 1.0 / np.maximum(w - 2 * spread, 1e-3)
                axes[2].plot(t, 100 * (depth / true[:, 0] - 1), color=colour, linewidth=1.2)
                axes[2].fill_between(t, 100 * (near / depth - 1), 100 * (far / depth - 1), color=colour,
                                     alpha=0.12, linewidth=0)  # fmt: skip
            axes[0].fill_between(t, near, far, color=colour, alpha=0.2, linewidth=0)
            axes[0].plot(t, depth, color=colour, linewidth=1.3, label=f"landmark {track}")
            axes[0].plot(t, true[:, 0], "--", color=TRUTH, linewidth=0.9)
            axes[1].plot(t, aside, color=colour, linewidth=1.3)
            axes[1].plot(t, true[:, 1], "--", color=TRUTH, linewidth=0.9)
        for at in axes:
            _shade(run, at)
        axes[0].set_ylim(0.0, 1.5 * farthest)
        axes[2].set_ylim(-20, 20)
        for at, name in zip(axes, ("p3, depth, m", "p1, to the right, m", "depth error, %"), strict=True):
            at.set_ylabel(name)
            at.grid(axis="y", color="#eeeeee")
        axes[2].set_xlabel("time, s")
        axes[0].legend(frameon=False, fontsize=8, ncols=3, loc="upper right")


def _draw_map(run: MappingDrive, path: Path) -> None:
    """The plan, in the anchor's frame: ways, and landmarks as they were known last, with their ellipses."""
    from matplotlib.patches import Polygon

    anchor_from_world, known = run.world_from_anchor.inverse(), LastKnown.of(run)
    true, _ = run.truth(known.ids)
    with _sheet(run, "plan, in the anchor's frame", path, (11, 8)) as figure:
        at = figure.add_subplot()
        for solid in (*run.world.plan.walls, *run.world.plan.furniture):
            corners = anchor_from_world.apply(solid.corners)
            at.add_patch(Polygon(corners, facecolor="#dddddd", edgecolor="#bbbbbb"))
        for who, colour, style, label in (
            ([m.wheels for m in run.moments], WHEELS, "-", "way by the wheels alone"),
            ([m.pose.mean for m in run.moments], ESTIMATE, "-", "way as estimated"),
            ([m.true for m in run.moments], TRUTH, "--", "true way"),
        ):
            way = np.array([pose.vector for pose in who])
            at.plot(way[:, 0], way[:, 1], style, color=colour, linewidth=1.1, label=label)
        for k, (point, covariance) in enumerate(zip(known.points, known.covariances, strict=True)):
            if np.isfinite(covariance).all():
                at.add_patch(_ellipse(point, covariance, 1.0 if known.converged[k] else 0.25))
            at.plot(*np.stack([point, true[k]])[:, :2].T, color="#999999", linewidth=0.8)
        at.plot(true[:, 0], true[:, 1], "x", color=TRUTH, markersize=5, label="landmarks, true")
        for chosen, fill, label in (
            (known.converged, GREEN, "landmarks, estimated, 2 sigma"),
            (~known.converged, "none", "landmarks lost before their depth was known"),
        ):
            at.plot(
                *known.points[chosen, :2].T, "o", color=GREEN, markerfacecolor=fill, markersize=4, label=label
            )
        shown = np.concatenate([true[:, :2], np.zeros((1, 2)), [m.true.vector[:2] for m in run.moments]])
        shown = shown[np.isfinite(shown).all(axis=1)]
        low, high = shown.min(axis=0) - 0.6, shown.max(axis=0) + 0.6
        at.set_xlim(low[0], high[0])
        at.set_ylim(low[1], high[1])
        at.set_aspect("equal")
        at.set_xlabel("x ahead, m")
        at.set_ylabel("y left, m")
        figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=8)


def _draw_view(run: MappingDrive, path: Path) -> None:
    """Three images with the last positions of tracks; colours show the distance from the true point."""
    with _sheet(run, "what the camera saw, and where its points went", path, (16, 4.6)) as figure:
        axes = np.atleast_1d(figure.subplots(1, len(run.images)))
        shade: Any = None
        for at, (number, image) in zip(axes, sorted(run.images.items()), strict=True):
            moment = run.moments[number]
            at.imshow(image, cmap="gray", vmin=0, vmax=255)
            for track, positions in _recent_tracks(run, number).items():
                held = track in moment.landmarks.ids
                at.plot(
                    positions[:, 0], positions[:, 1], color="#ffd34d" if held else "#7fb3d5", linewidth=0.8
                )
            off = np.linalg.norm(track_errors(run, moment), axis=1)
            size = np.where(np.isin(moment.ids, moment.landmarks.ids), 26, 9)
            shade = at.scatter(*moment.pixels.T, c=off, s=size, cmap="plasma", vmin=0, vmax=2)
            counts = f"{len(moment.ids)} tracks, {len(moment.landmarks.ids)} landmarks"
            at.set_title(f"{run.seconds[number]:.1f} s: {counts}", fontsize=9)
            at.set_xlim(0, image.shape[1] - 1)
            at.set_ylim(image.shape[0] - 1, 0)
            at.axis("off")
        figure.colorbar(shade, ax=axes, label="track from its true point, px", shrink=0.8)


def _shade(run: MappingDrive, at: Any) -> None:
    """Mark when a person is in view."""
    there = np.array([not math.isnan(m.person) for m in run.moments])
    if there.any():
        at.fill_between(run.seconds, 0, 1, where=there, color=PERSON, linewidth=0, zorder=0,
                        transform=at.get_xaxis_transform(), label="person in view")  # fmt: skip


def _sigmas_in_anchor(covariance: Array, heading: float) -> Array:
    """(3,) standard deviations in the anchor's frame of a pose perturbed in its own."""
    turn = np.eye(3)
    turn[:2, :2] = [[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]]
    return np.sqrt(np.diag(turn @ covariance @ turn.T))


def _true_steps(run: MappingDrive) -> Array:
    """(T, 2) true way forward m and turn rad of each tick, as perfect encoders would tell them."""
    steps = [(0.0, 0.0)]
    for before, after in zip(run.moments, run.moments[1:], strict=False):
        moved = before.true.inverse() @ after.true
        half = moved.heading / 2
        steps.append((moved.x * math.cos(half) + moved.y * math.sin(half), moved.heading))
    return np.array(steps)


def _choose(run: MappingDrive, most: int) -> list[int]:
    """Landmarks on one surface that lived long, from near to far."""
    first = run.moments[0].landmarks.ids
    points, flat = run.truth(first)
    lives = np.array([sum(i in m.landmarks.ids for m in run.moments) for i in first.tolist()])
    longest = np.argsort(-lives * flat, kind="stable")[: min(2 * most, int(flat.sum()))]
    by_depth = longest[np.argsort(points[longest, 0])]
    picked = np.linspace(0, len(by_depth) - 1, min(most, len(by_depth))).round().astype(int)
    return [int(i) for i in first[by_depth[picked]]]


def _history(run: MappingDrive, track: int) -> tuple[Array, Array]:
    """A landmark in the camera over time: (T, 3) depth, its sigma, right, m, and (T, 2) the true two."""
    believed = np.full((len(run.moments), 3), np.nan)
    true = np.full((len(run.moments), 2), np.nan)
    point = run.truth(np.array([track]))[0][0]
    for k, moment in enumerate(run.moments):
        at = moment.true.inverse().apply(point)
        true[k] = at[0] - run.robot.camera.mount_forward, -at[1]
        row = np.flatnonzero(moment.landmarks.ids == track)
        if len(row) and np.isfinite(moment.landmarks.depths[row[0]]):
            known = moment.landmarks
            believed[k] = known.depths[row[0]], known.depth_sigmas[row[0]], -known.points_in_robot[row[0], 1]
    true[np.isnan(believed[:, 0])] = np.nan
    return believed, true


def _recent_tracks(run: MappingDrive, number: int) -> dict[int, Array]:
    """The last pixels (K, 2) of each track alive at a moment; NaN where it was not."""
    alive = run.moments[number].ids
    recent = run.moments[max(0, number - TRACK_LENGTH) : number + 1]
    pixels = np.full((len(alive), len(recent), 2), np.nan)
    for k, moment in enumerate(recent):
        _, rows, there = np.intersect1d(alive, moment.ids, return_indices=True)
        pixels[rows, k] = moment.pixels[there]
    return dict(zip(alive.tolist(), pixels, strict=True))


def _ellipse(point: Array, covariance: Array, alpha: float) -> Ellipse:
    """Two standard deviations in the plane."""
    from matplotlib.patches import Ellipse

    values, vectors = np.linalg.eigh(covariance)
    width, height = 4.0 * np.sqrt(np.maximum(values, 0.0))
    angle = math.degrees(math.atan2(vectors[1, 0], vectors[0, 0]))
    at = float(point[0]), float(point[1])
    return Ellipse(
        at, width, height, angle=angle, facecolor="none", edgecolor=GREEN, linewidth=0.9, alpha=alpha
    )
