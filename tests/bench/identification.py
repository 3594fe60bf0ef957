"""Identification beside cv2.findCirclesGrid on the same rendered frames: found, mis-indexed, refused.

Thirteen scenes of the paper's target at 5 MP, ten random poses each, and seven other targets; all are rendered.
"Wrong" is an answer that puts at least one marker in another's place. findCirclesGrid begins at any corner it likes, so
the peer's grid counts as found in all four orders along the rows.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from tests.bench.figures import Figure, report_progress, set_lower_goal
from tests.compensation.identification_scenes import SCENES, TARGETS, Image, draw_pose, find_own_centres, judge
from tests.compensation.renderer import Float, Scene, photograph, render
from thermostand.markers.target import Target, load_target
from thermostand.stand.config.stand_config import find_packaged

POSES = 10
POSES_OF_TARGETS = 5
PEERS_MOST_MARKERS = 300
"""With 1200 markers findCirclesGrid takes minutes for a frame."""
Finder = Callable[[Image, Target], Float | None]
"""Image, target -> centres (N, 2), NaN for markers not found; None for a refusal."""


def make_circles_grid_finder(tuned: bool, clustering: bool) -> Finder:
    """The peer, with OpenCV's default blob detector or one for these discs, and either way of finding the grid."""

    def found(image: Image, target: Target) -> Float | None:
        flags = cv2.CALIB_CB_ASYMMETRIC_GRID if target.layout == "staggered" else cv2.CALIB_CB_SYMMETRIC_GRID
        flags |= cv2.CALIB_CB_CLUSTERING if clustering else 0
        size = (target.columns, target.rows)
        blobs = (
            cv2.SimpleBlobDetector.create(_make_tuned_parameters(target)) if tuned else cv2.SimpleBlobDetector.create()
        )
        success, centres = cv2.findCirclesGrid(image, size, flags=flags, blobDetector=blobs)
        return centres.reshape(-1, 2).astype(np.float64) if success else None

    return found


def _make_tuned_parameters(target: Target) -> cv2.SimpleBlobDetector.Params:
    blobs = cv2.SimpleBlobDetector.Params()
    blobs.minArea, blobs.maxArea, blobs.minDistBetweenBlobs = 20, 2e5, 4
    blobs.minThreshold, blobs.maxThreshold, blobs.thresholdStep = 40, 180, 20
    blobs.filterByInertia, blobs.minConvexity = False, 0.9
    blobs.blobColor = 0 if target.polarity == "dark" else 255
    return blobs


PEERS: dict[str, Finder] = {
    "default": make_circles_grid_finder(tuned=False, clustering=False),
    "tuned": make_circles_grid_finder(tuned=True, clustering=False),
    "clustering": make_circles_grid_finder(tuned=True, clustering=True),
}


def figures(directory: Path) -> list[Figure]:
    """Of ten poses of each scene, how many are identified, own beside the peer's three settings."""
    paper = load_target(find_packaged("targets", "paper-9x6"))
    rows = [_score_row(name, [draw_pose(name, seed) for seed in range(POSES)], paper) for name in SCENES]
    for name, (target, scene) in TARGETS.items():
        rows.append(
            _score_row(name, [draw_pose(name, seed, {name: scene}) for seed in range(POSES_OF_TARGETS)], target)
        )
    return rows


def _score_row(name: str, scenes: list[Scene], target: Target) -> Figure:
    report_progress(f"identification, {name}")
    verdicts: dict[str, list[str]] = {"own": [], **{peer: [] for peer in PEERS}}
    for seed, scene in enumerate(scenes):
        image = photograph(scene, render(scene), seed)
        verdicts["own"].append(judge(find_own_centres(image, target), scene, own_order=True))
        for peer, finder in PEERS.items() if target.count <= PEERS_MOST_MARKERS else ():
            verdicts[peer].append(judge(finder(image, target), scene, own_order=False))
    peers = ", ".join(f"{peer} {_format_score(verdicts[peer])}" for peer in PEERS if verdicts[peer]) or "not run"
    found, wrong = verdicts["own"].count("found"), verdicts["own"].count("wrong")
    row = Figure(f"identified, {name}", f"of {len(scenes)}, {wrong} wrong", found, f"cv2.findCirclesGrid: {peers}")
    return set_lower_goal(len(scenes), row)


def _format_score(verdicts: list[str]) -> str:
    wrong = verdicts.count("wrong")
    return f"{verdicts.count('found')}" + (f" ({wrong} wrong)" if wrong else "")
