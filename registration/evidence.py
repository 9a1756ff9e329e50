"""Evidence for or against a recognition, in addition to the number of inliers."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.node import Landmarks
from mapweave.hybridmap.pose import Pose2
from mapweave.registration.gauss_newton import PlanarFix
from mapweave.registration.sightings import Sightings

GRID = (6, 4)
"""Columns and rows of cells in which the spread over an image is counted."""


def gather(
    a: Landmarks,
    camera_a: Camera,
    b: Landmarks,
    camera_b: Camera,
    inliers: NDArray[np.int64],
    matches: int,
    usable: int,
    fix: PlanarFix,
) -> dict[str, float]:
    """The evidence for a pose; all finite.

    Args:
        a: landmarks of the first side.
        camera_a: its camera.
        b: landmarks of the other side.
        camera_b: its camera.
        inliers: (K, 2) indices in a and b that agree.
        matches: mutual matches.
        usable: of these, with a depth on either side.
        fix: the pose `a_from_b`.
    """
    landmarks_a, landmarks_b = a.take(inliers[:, 0]), b.take(inliers[:, 1])
    depths = np.where(landmarks_a.has_depth, landmarks_a.depths, landmarks_b.depths)
    sigmas = np.sqrt(np.linalg.eigvalsh(fix.node_from_robot.covariance[:2, :2]))
    return {
        "inliers": float(len(inliers)),
        "inliers_a": float(landmarks_a.has_depth.sum()),
        "inliers_b": float(landmarks_b.has_depth.sum()),
        "inliers_3d": float((landmarks_a.has_depth & landmarks_b.has_depth).sum()),
        "matches": float(matches),
        "share": len(inliers) / usable,
        "cells": float(min(cells(landmarks_a.pixels, camera_a), cells(landmarks_b.pixels, camera_b))),
        "seen": max(
            _visible(a, camera_a, camera_b, fix.node_from_robot.mean, inliers[:, 0]),
            _visible(b, camera_b, camera_a, fix.node_from_robot.mean.inverse(), inliers[:, 1]),
        ),
        "log_evidence": fix.log_evidence,
        "mean_square": fix.mean_square,
        "rms_px": fix.rms_px,
        "depth": float(np.median(depths)),
        "sigma_xy": float(sigmas[-1]),
        "sigma_heading": math.sqrt(float(fix.node_from_robot.covariance[2, 2])),
    }


def _visible(
    landmarks: Landmarks,
    camera: Camera,
    view_camera: Camera,
    landmarks_from_view: Pose2,
    inliers: NDArray[np.int64],
) -> float:
    """Share of the landmarks that should be in the other image, by their depth, that are inliers."""
    points = landmarks_from_view.inverse().apply(landmarks.points_in_robot(camera))
    expected = int(view_camera.contains(view_camera.project(points)).sum())
    return min(float(landmarks.has_depth[inliers].sum()) / max(expected, 1), 1.0)


def depth_agreement(forward: Sightings, fix: PlanarFix) -> float:
    """Share of the landmarks whose pixels fit the pose that fit in depth too; 1 if few have two depths."""
    both = forward.depth_measured
    nothing = np.full(len(forward), np.nan)
    pixels_only = replace(forward.levelled(fix.pitch), depths=nothing, depth_sigmas=nothing)
    pose = fix.node_from_robot.mean.vector[None]
    fits = (pixels_only.log_ratios(pose)[0] > 0) & both
    if fits.sum() < 5:
        return 1.0
    return float((fits & fix.inliers[: len(forward)]).sum() / fits.sum())


def cells(pixels: NDArray[np.float32], camera: Camera) -> int:
    """How many cells of the grid over the image are occupied."""
    column = np.clip(pixels[:, 0] * GRID[0] / camera.width, 0, GRID[0] - 1).astype(int)
    row = np.clip(pixels[:, 1] * GRID[1] / camera.height, 0, GRID[1] - 1).astype(int)
    return len(np.unique(column * GRID[1] + row))
