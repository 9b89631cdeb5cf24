"""Pose graph optimisers: compared with GTSAM, with false loops, and by rotation parametrisation.

    python benchmarks/pose_graphs.py [GRAPH.g2o ...] [--simulated] [--seeds 10] [--figure FILE.png]

1. For each g2o file: half the squared error as computed by GTSAM, and the time on one thread, of
   GTSAM's Levenberg-Marquardt and ours, as in `tofuse optimize`, from the same initial values
   (needs gtsam); the fraction by which other poses could be better, at most, and the time to
   certify it. `--simulated` adds a torus and spheres with much noise, with as many poses as the
   public ones, and laps that drift.
2. A camera that rotates in a room and one that walks in a circle, with noise according to the
   information matrices. Loops connect nearby views; 30 % of them are false, with gross errors. Mean
   ATE in mm over the seeds, with and without false loops, and the largest ratio of the two.
3. The objective relative to its minimum at every iteration, for each rotation parametrisation.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize
from threadpoolctl import threadpool_limits

from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import quaternion, se3
from tofuse.engine.graph.castellani import Castellani
from tofuse.engine.graph.certificate import certify
from tofuse.engine.graph.graph import Optimiser, PoseGraph
from tofuse.engine.graph.levenberg import LevenbergMarquardt, minimise
from tofuse.engine.graph.robust import Settings
from tofuse.engine.graph.sparse import equations
from tofuse.engine.quality.trajectory_errors import align
from tofuse.formats.poses.g2o import read_g2o, write_g2o
from tofuse.lab.methods.charts import Cosines, Quaternion, descend
from tofuse.lab.methods.elch import Elch
from tofuse.lab.methods.lu_milios import LuMilios
from tofuse.lab.world.laps import drifting_laps

FALSE = 0.3  # fraction of false loops
ODOMETRY = np.array([0.004] * 3 + [np.radians(0.2)] * 3)  # standard deviations, m and rad
LOOPS = np.array([0.010] * 3 + [np.radians(0.4)] * 3)


def path(scene: str) -> Float64:
    """Poses of a camera that rotates more than once (room), or walks a circle of 12 m (walk)."""
    n, radius = (120, 0.1) if scene == "room" else (150, 12 / (2 * np.pi))
    angle = 2 * np.pi * np.arange(n) / (n - 15)
    zero = np.zeros(n)
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = se3.so3_exp(np.stack([zero, angle, zero], axis=1))
    height = 0.05 * np.sin(9 * angle)
    T[:, :3, 3] = np.stack([radius * np.sin(angle), height, radius * np.cos(angle)], axis=1)
    return se3.inverse(T[0]) @ T


def make_graph(
    scene: str, seed: int, fraction: float, noise: float = 1.0
) -> tuple[PoseGraph, Float64]:
    """Simulate measurements, with a `fraction` of false loops; true ones do not depend on it."""
    rng = np.random.default_rng([seed, scene == "walk"])
    T = path(scene)
    n = len(T)
    i, j = np.arange(n - 1), np.arange(1, n)
    a, b = np.triu_indices(n, 15)
    T_a_b = se3.inverse(T[a]) @ T[b]
    near = (np.linalg.norm(T_a_b[:, :3, 3], axis=1) < 0.6) & (se3.angle(T_a_b) < np.radians(35))
    true = rng.choice(np.flatnonzero(near), 40, replace=False)
    measured = [
        se3.inverse(T[i]) @ T[j] @ se3.exp(noise * rng.normal(size=(n - 1, 6)) * ODOMETRY),
        T_a_b[true] @ se3.exp(noise * rng.normal(size=(40, 6)) * LOOPS),
    ]
    false = rng.choice(len(a), round(40 * fraction / (1 - fraction)), replace=False)
    k = len(false)
    wrong = np.concatenate([rng.uniform(-3, 3, (k, 3)), rng.normal(size=(k, 3))], axis=1)
    measured.append(se3.exp(wrong))
    sigma = np.concatenate([np.tile(ODOMETRY, (n - 1, 1)), np.tile(LOOPS, (40 + k, 1))]) * noise
    ends = np.concatenate([[*zip(i, j, strict=True)], np.stack([a, b], 1)[[*true, *false]]])
    poses = [T[0]]
    for step in measured[0]:
        poses.append(se3.orthonormalise(poses[-1] @ step))
    information = np.zeros((len(ends), 6, 6))
    information[:, range(6), range(6)] = sigma**-2
    loop = np.arange(len(ends)) >= n - 1
    Z = np.concatenate(measured)
    return PoseGraph(np.arange(n), np.array(poses), ends, Z, information, loop), T


def ate(graph: PoseGraph, truth: Float64) -> float:
    """Rms distance of the positions after the best rigid alignment, m."""
    T = align(graph.poses, truth)
    moved = se3.transform(T, graph.poses[:, :3, 3])
    return float(np.sqrt(((moved - truth[:, :3, 3]) ** 2).sum(1).mean()))


def compare_with_gtsam(files: list[Path], repeats: int = 3) -> None:
    """Print errors and times of GTSAM and of our optimiser."""
    try:
        import gtsam
    except ImportError:
        print("gtsam is not installed")
        return
    print(f"{'graph':<26} {'poses':>6} {'edges':>6} {'start':>11} {'GTSAM':>14} {'ours':>14} "
          f"{'ratio - 1':>10} {'GTSAM s':>8} {'ours s':>7} {'ratio':>6} {'gap':>8} "
          f"{'eigenvalue':>10} {'s':>6}")  # fmt: skip
    for file in files:
        ours = read_g2o(file)
        graph, start = gtsam.readG2o(str(file), True)
        first = min(start.keys())
        graph.add(
            gtsam.PriorFactorPose3(first, start.atPose3(first), gtsam.noiseModel.Constrained.All(6))
        )
        times: dict[str, list[float]] = {"gtsam": [], "ours": [], "certificate": []}
        for _ in range(repeats):  # side by side
            began = time.process_time()
            found = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
            times["gtsam"].append(time.process_time() - began)
            began = time.process_time()
            done = LevenbergMarquardt("none", start="best").optimise(ours)
            times["ours"].append(time.process_time() - began)
            began = time.process_time()
            certified = certify(done.graph)
            times["certificate"].append(time.process_time() - began)
        theirs = graph.error(found)
        # Evaluated by GTSAM, from the written file.
        mine = score(gtsam, graph, done.graph)
        a, b, c = (statistics.median(seconds) for seconds in times.values())
        gap = (
            ""
            if certified is None
            else f"{certified.gap:>8.2%} {certified.eigenvalue or np.nan:>10.1e}"
        )
        print(
            f"{file.stem:<26} {len(ours.ids):>6} {len(ours.edges):>6} {graph.error(start):>11.4g} "
            f"{theirs:>14.8g} {mine:>14.8g} {mine / theirs - 1:>10.1e} {a:>8.3f} {b:>7.3f} "
            f"{b / a:>6.2f} {gap:>19} {c:>6.3f}"
        )


def simulated(kind: str) -> PoseGraph:
    """A graph like those of Carlone et al., "Initialization techniques for 3D SLAM" (2015)."""
    rng = np.random.default_rng(7)
    turns, each = (100, 50) if kind == "torus" else (50, 44)
    k = np.arange(turns * each)
    around, along = 2 * np.pi * k / each, (k / each) / turns
    if kind == "torus":
        out, radius = 2 * np.pi * along, 10.0
        ring = radius + 3 * np.cos(around)
        position = np.stack([ring * np.cos(out), ring * np.sin(out), 3 * np.sin(around)], 1)
    else:
        polar, radius = np.pi * (0.02 + 0.96 * along), 50.0
        position = radius * np.stack(
            [np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], 1
        )
    loops = [(m - each, m) for m in range(each, len(k))]
    if kind != "torus":
        loops += [(m - each - 1, m) for m in range(each + 1, len(k))]
    sigma_m, sigma_rad = (0.05, 0.03) if kind == "torus" else (0.5, 0.1)
    true = 3.0 if kind == "big noise" else 1.0  # noise, in units of the stated one
    n = len(position)
    truth = np.asarray(se3.exp(np.concatenate([np.zeros((n, 3)), rng.normal(size=(n, 3))], 1)))
    truth[:, :3, 3] = position
    edges = np.concatenate([np.stack([np.arange(n - 1), np.arange(1, n)], 1), loops])
    i, j = edges.T
    sigma = np.array([sigma_m] * 3 + [sigma_rad] * 3)
    noise = se3.exp(true * rng.normal(size=(len(edges), 6)) * sigma)
    measured = se3.inverse(truth[i]) @ truth[j] @ noise
    start = np.empty_like(truth)
    start[0] = truth[0]
    for k in range(1, n):
        start[k] = start[k - 1] @ measured[k - 1]
    information = np.tile(np.diag(sigma**-2), (len(edges), 1, 1))
    return PoseGraph(
        np.arange(n), start, edges, measured, information, np.arange(len(edges)) >= n - 1
    )


def score(gtsam: Any, factors: Any, graph: PoseGraph) -> float:
    """GTSAM's error of our poses, read from the file that `tofuse optimize` writes."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "optimised.g2o"
        write_g2o(file, graph)
        _, values = gtsam.readG2o(str(file), True)
        return float(factors.error(values))


def with_false_loops(seeds: int) -> None:
    """Print the effect of false loops on each optimiser."""
    optimisers: dict[str, Optimiser | None] = {
        "odometry": None,
        "levenberg-marquardt": LevenbergMarquardt(),
        "  robust = none": LevenbergMarquardt(robust="none"),
        "  robust = huber": LevenbergMarquardt(robust="huber", gate=16.0),
        "  robust = cauchy": LevenbergMarquardt(robust="cauchy", gate=16.0),
        "  robust = dcs": LevenbergMarquardt(robust="dcs", gate=16.0),
        "  robust = switchable": LevenbergMarquardt(robust="switchable", gate=16.0),
        "castellani (thesis)": Castellani(),
        "lu-milios": LuMilios(),
        "elch": Elch(),
    }
    head = f"{'':<22}" + "".join(f"{s:^36}" for s in ("room", "walk"))
    print(head)
    print(f"{'ATE in mm':<22}" + f"{'no false':>12}{'30 % false':>12}{'worst':>9}   " * 2)
    for name, optimiser in optimisers.items():
        cells = ""
        for scene in ("room", "walk"):
            errors = np.empty((seeds, 2))
            for seed in range(seeds):
                for k, fraction in enumerate((0.0, FALSE)):
                    graph, truth = make_graph(scene, seed, fraction)
                    done = graph if optimiser is None else optimiser.optimise(graph).graph
                    errors[seed, k] = 1000 * ate(done, truth)
            ratio = (errors[:, 1] / errors[:, 0]).max()
            cells += f"{errors[:, 0].mean():>12.1f}{errors[:, 1].mean():>12.1f}{ratio:>9.2f}   "
        print(f"{name:<22}{cells}")


def general_solver(graph: PoseGraph) -> list[float]:
    """Objective at every step of L-BFGS over quaternions and positions, a generic solver."""
    chart, i, j = Quaternion(), *graph.edges.T
    history = [graph.chi2()]

    def poses_of(x: Float64) -> Float64:
        x = x.reshape(-1, 7)
        T = np.tile(np.eye(4), (len(x) + 1, 1, 1))
        T[0] = graph.poses[0]
        T[1:, :3, :3] = quaternion.to_matrix(x[:, 3:])
        T[1:, :3, 3] = x[:, :3]
        return T

    def value(x: Float64) -> tuple[float, Float64]:
        T = poses_of(x)
        here = graph.with_poses(T)
        pull = 2 * equations(here.residuals(), graph.information)[1][..., None]
        A = se3.adjoint(se3.inverse(T[j]) @ T[i])
        g = np.zeros((len(T), 6))
        np.add.at(g, j, pull[..., 0])
        np.add.at(g, i, -(np.swapaxes(A, 1, 2) @ pull)[..., 0])
        P, _ = chart.basis(T)
        by_numbers = (np.swapaxes(P, 1, 2) @ g[..., None])[1:, :, 0]
        # Positions are in the world frame here; q and -q are the same rotation.
        by_numbers[:, :3] = (T[1:, :3, :3] @ by_numbers[:, :3, None])[..., 0]
        q = x.reshape(-1, 7)[:, 3:]
        sign = np.sign((quaternion.from_matrix(T[1:, :3, :3]) * q).sum(1))
        by_numbers[:, 3:] *= (sign / np.linalg.norm(q, axis=1))[:, None]
        return here.chi2(), by_numbers.ravel()

    start = np.concatenate(
        [graph.poses[1:, :3, 3], quaternion.from_matrix(graph.poses[1:, :3, :3])], axis=1
    )
    minimize(
        value, start.ravel(), jac=True, method="L-BFGS-B",
        callback=lambda x: history.append(value(x)[0]), options={"maxiter": 3000, "maxfun": 6000},
    )  # fmt: skip
    return history


def convergence(figure: Path | None) -> None:
    """Print and plot the convergence of the objective."""
    graph, _ = make_graph("walk", 0, 0.0, noise=8.0)
    curves: dict[str, list[float]] = {}
    own = minimise(graph, Settings("none", tolerance=1e-13))
    curves["Levenberg-Marquardt, tangent"] = list(own.objective)
    for name, chart in (("quaternion", Quaternion()), ("cosines", Cosines())):
        log = descend(graph, chart, tolerance=1e-13).log
        curves[f"Levenberg-Marquardt, {name}"] = [float(chi2.sum()) for chi2, _ in log]
    curves["Lu-Milios"] = list(LuMilios(tolerance=1e-13).optimise(graph).objective)
    curves["generic solver (L-BFGS), quaternion"] = general_solver(graph)
    minimum = min(min(c) for c in curves.values())
    steps = (0, 1, 2, 3, 5, 10, 100, 1000)
    print(f"{'objective / minimum - 1':<38}" + "".join(f"{k:>10}" for k in steps))
    for name, curve in curves.items():
        cells = "".join(f"{curve[k] / minimum - 1:>10.1e}" for k in steps if k < len(curve))
        print(f"{name:<38}{cells}   ({len(curve) - 1} steps)")
    if figure is not None:
        draw(curves, minimum, figure)


def draw(curves: dict[str, list[float]], minimum: float, file: Path) -> None:
    """Plot the curves, with a logarithmic axis of steps."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    fig, ax = plt.subplots(figsize=(6.4, 3.6), dpi=110, layout="constrained")
    styles = ("o-", "s--", "^:", "d-.", "-")
    for (name, curve), style in zip(curves.items(), styles, strict=True):
        above = np.maximum(np.array(curve) / minimum - 1, 1e-12)
        ax.loglog(np.arange(1, len(above) + 1), above, style, label=name, markersize=4, lw=1.2)
    ax.set(xlabel="evaluation", ylabel="objective / minimum - 1")
    ax.legend(fontsize=8)
    ax.grid(alpha=0.3)
    fig.savefig(file)


def main(arguments: list[str] | None = None) -> None:
    """Print the three tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("graphs", nargs="*", type=Path)
    parser.add_argument("--simulated", action="store_true")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--figure", type=Path)
    options = parser.parse_args(arguments)
    with threadpool_limits(1), tempfile.TemporaryDirectory() as folder:
        graphs = list(options.graphs)
        if options.simulated:
            laps, _ = drifting_laps(30, 12, 60.0)
            made = {kind: simulated(kind) for kind in ("sphere", "big noise", "torus")}
            made["laps"] = laps
            for kind, graph in made.items():
                graphs.append(Path(folder) / f"{kind}, simulated.g2o")
                write_g2o(graphs[-1], graph)
        if graphs:
            compare_with_gtsam(graphs)
            print()
        with_false_loops(options.seeds)
        print()
        convergence(options.figure)


if __name__ == "__main__":
    main()
