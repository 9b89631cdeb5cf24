"""Global registration of two bare clouds: success of `tofuse.register`, and its calibration.

`table` prints, for each family of pairs (`cloud_kinds.py`), how many poses are right (within 0.1 m,
or 5 % of the extent if that is less, at the centre of the source, and 4 degrees; fragments of
3DMatch as its papers define it: an approximate rms error within 0.2 m), how many of those are
accepted, and how many are accepted and wrong; also for the peers that are installed, with voxels of
1/100 of the target's extent: Open3D's RANSAC over FPFH with point-to-plane ICP, KISS-Matcher, also
with small_gicp and FRICP, small_gicp from the identity, and splatreg's classical seed. In brackets
is the mean over scenes, or angles of the dragon, whose counts follow. Results are kept in a
journal, if one is given, to continue from.

`fit` fits the logistic models of `tofuse.engine.search.pose_probability`, and prints how families
fare that are left out of the fit (`cloud_belief.py`). `viewpoints` counts the clouds whose origin
is taken for the viewpoint.

    python benchmarks/cloud_pairs.py table [--data ../shared/data] [--kinds dragon] [--pairs 2]
    python benchmarks/cloud_pairs.py fit
    python benchmarks/cloud_pairs.py viewpoints
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

import cloud_belief
import cloud_kinds
import tofuse
from attacks.journal import Lines
from cloud_kinds import KINDS, Pair
from peers import kiss_global, o3d_global, splat_global
from sequences import DATA
from tofuse.engine.alignment.base import Registration
from tofuse.engine.arrays import Float64
from tofuse.engine.clouds.viewpoint import viewpoint_of
from tofuse.engine.errors import TofuseError
from tofuse.engine.frames.frames import CloudFrame, Frame

Method = Callable[[Frame, Frame], Registration | Float64]
# Peers by title; each is made for a voxel size.
PEERS: dict[str, Callable[[float], Method | None]] = {
    "Open3D": o3d_global.method,
    "KISS-Matcher": kiss_global.method,
    "KISS-Matcher, GICP": kiss_global.with_gicp,
    "KISS-Matcher, FRICP": kiss_global.with_fricp,
    "GICP": kiss_global.gicp,
    "splatreg": splat_global.method,
}
_OURS = "tofuse"


@dataclass(frozen=True)
class Result:
    """What a method found for a pair: whether it is right, its belief, and seconds of the CPU."""

    kind: str
    pair: int
    scene: str
    method: str
    right: bool
    accepted: bool
    probability: float
    seconds: float

    @property
    def family(self) -> str:
        return KINDS[self.kind].family


def results(names: list[str], data: Path, max_pairs: int, journal: Lines) -> list[Result]:
    """Results of all methods, of the journal or new."""
    done = {(row["kind"], row["pair"], row["method"]) for row in journal.records}
    for name in names:
        for number, pair in enumerate(cloud_kinds.made(name, data, max_pairs)):
            methods = {_OURS: tofuse.register} | {
                title: method
                for title, make in PEERS.items()
                if (method := make(pair.extent / 100)) is not None
            }
            for title, method in methods.items():
                if (name, number, title) not in done:
                    found = _result(name, number, pair, title, method)
                    journal.add(asdict(found))
    return [Result(**row) for row in journal.records if row["kind"] in names]


def _result(name: str, number: int, pair: Pair, title: str, method: Method) -> Result:
    """A failed registration counts as wrong."""
    views = CloudFrame.of(pair.source, index=1), CloudFrame.of(pair.target)
    right = accepted = False
    p = 0.0
    start = time.process_time()
    try:
        found = method(*views)
    except TofuseError:
        found = None
    seconds = time.process_time() - start
    if isinstance(found, Registration):
        right, accepted = pair.is_right(found.T_target_source), bool(found.believed)
        p = found.probability or 0.0
    elif found is not None:
        right = pair.is_right(found)
    return Result(name, number, pair.scene, title, right, accepted, p, seconds)


def print_table(names: list[str], data: Path, max_pairs: int, journal: Lines) -> None:
    """Print a row for each family, then the reliability of the stated probabilities."""
    found = results(names, data, max_pairs, journal)
    peers = [title for title in PEERS if any(r.method == title for r in found)]
    titles = ["clouds", "right", "of these accepted", "accepted and wrong", "s", *peers]
    print(f"\n| {' | '.join(titles)} |\n|{'---|' * len(titles)}")
    outcomes = {}
    for family in dict.fromkeys(r.family for r in found):
        mine = [r for r in found if r.family == family]
        ours = [r for r in mine if r.method == _OURS]
        cells = [family, _recall(ours), sum(r.right and r.accepted for r in ours)]
        cells += [sum(r.accepted and not r.right for r in ours), _seconds(ours)]
        cells += [
            f"{_recall(theirs)}, {_seconds(theirs)} s" if theirs else ""
            for theirs in ([r for r in mine if r.method == title] for title in peers)
        ]
        print(f"| {' | '.join(map(str, cells))} |")
        outcomes[family] = np.array([(r.probability, r.right) for r in ours], float)
    print()
    for family, scene in dict.fromkeys((r.family, r.scene) for r in found if r.scene):
        rows = [r for r in found if (r.family, r.scene, r.method) == (family, scene, _OURS)]
        print(f"{family}, {scene}: {_counts(rows)}")
    print()
    cloud_belief.print_outcomes(outcomes)


def _counts(found: list[Result]) -> str:
    """The number of right poses."""
    return f"{sum(r.right for r in found)} of {len(found)}"


def _recall(found: list[Result]) -> str:
    """The number of right poses; of benchmarks also the mean over scenes of their share."""
    count = _counts(found)
    scenes = {r.scene for r in found if r.scene}
    if not scenes:
        return count
    shares = [np.mean([r.right for r in found if r.scene == scene]) for scene in scenes]
    return f"{count} ({np.mean(shares):.3f})"


def _seconds(found: list[Result]) -> str:
    return f"{np.median([r.seconds for r in found]):.1f}"


def print_viewpoints(names: list[str], data: Path, max_pairs: int) -> None:
    """Print for how many clouds of each kind the origin is taken for the viewpoint."""
    for name in names:
        pairs_of = cloud_kinds.made(name, data, max_pairs)
        clouds = [points for pair in pairs_of for points in (pair.source, pair.target)]
        if clouds:
            found = sum(viewpoint_of(CloudFrame.of(points)) is not None for points in clouds)
            print(f"{name}: the origin is taken for the viewpoint of {found} of {len(clouds)}")


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("what", choices=["table", "fit", "viewpoints"])
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--kinds", nargs="*", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--pairs", type=int, default=2, help="pairs for each step")
    parser.add_argument("--journal", type=Path, help="file of results, to continue from")
    given = parser.parse_args(arguments)
    if given.what == "table":
        journal = Lines(given.journal, {"pairs": given.pairs})
        print_table(given.kinds, given.data, given.pairs, journal)
    elif given.what == "viewpoints":
        print_viewpoints(given.kinds, given.data, given.pairs)
    else:
        cloud_belief.print_fit(given.data, given.pairs)


if __name__ == "__main__":
    main()
