"""g2o files: round trip, and one-line errors for invalid files."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from tofuse.engine.errors import InputError, InputWarning, OutputError
from tofuse.engine.geometry import se3
from tofuse.engine.graph.graph import Measured, PoseGraph, build_graph
from tofuse.formats.poses.g2o import read_g2o, write_g2o

VERTICES = "VERTEX_SE3:QUAT 3 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 7 1 2 3 0 0 0.6 0.8\n"
UPPER = " ".join(str(v) for v in np.eye(6)[np.triu_indices(6)])
EDGE = f"EDGE_SE3:QUAT 3 7 1 2 3 0 0 0.6 0.8 {UPPER}\n"


def some_graph(seed: int = 0) -> PoseGraph:
    rng = np.random.default_rng(seed)
    n = 6
    ids = [0, 3, 4, 9, 12, 40]
    poses = se3.exp(rng.normal(size=(n, 6)) * [9, 9, 9, 1, 1, 1])
    edges = []
    for a in range(n):
        root = rng.normal(size=(6, 6))
        information = root @ root.T * 10.0 ** rng.integers(-3, 6)
        edges.append(Measured(ids[a], ids[(a + 1) % n], se3.exp(rng.normal(size=6)), information))
    return build_graph(ids, poses, edges[:-1], edges[-1:])


def test_round_trip_preserves_all_digits(tmp_path):
    graph = some_graph()
    write_g2o(tmp_path / "a.g2o", graph)
    back = read_g2o(tmp_path / "a.g2o")
    np.testing.assert_array_equal(back.ids, graph.ids)
    np.testing.assert_array_equal(back.edges, graph.edges)
    np.testing.assert_array_equal(back.loop, graph.loop)
    np.testing.assert_array_equal(back.poses[:, :3, 3], graph.poses[:, :3, 3])
    np.testing.assert_allclose(back.poses, graph.poses, atol=2e-15)
    np.testing.assert_allclose(back.measurements, graph.measurements, atol=2e-15)
    upper = np.triu_indices(6)
    np.testing.assert_array_equal(
        back.information[:, upper[0], upper[1]], graph.information[:, upper[0], upper[1]]
    )
    np.testing.assert_array_equal(back.information, np.swapaxes(back.information, 1, 2))
    assert back.chi2() == pytest.approx(graph.chi2(), rel=1e-9)


def test_conventions_of_a_line(tmp_path):
    """Columns, the order (t, r) of the information, and the error log(Z^-1 T_i^-1 T_j)."""
    file = tmp_path / "a.g2o"
    information = np.diag([1.0, 2, 3, 4, 5, 6])
    information[0, 5] = information[5, 0] = 0.5
    upper = " ".join(str(v) for v in information[np.triu_indices(6)])
    file.write_text(
        "VERTEX_SE3:QUAT 5 0 0 0 0 0 0 1\n"
        f"VERTEX_SE3:QUAT 6 1 2 3 0 0 {np.sin(0.2)} {np.cos(0.2)}\n"
        f"EDGE_SE3:QUAT 5 6 1 2 3 0 0 {np.sin(0.15)} {np.cos(0.15)} {upper}\n"
    )
    graph = read_g2o(file)
    np.testing.assert_allclose(graph.poses[1], se3.exp([0, 0, 0, 0, 0, 0.4]) + _at(1, 2, 3))
    np.testing.assert_array_equal(graph.information[0], information)
    # 0.1 rad about z, information 6 per radian squared.
    np.testing.assert_allclose(graph.residuals()[0], [0, 0, 0, 0, 0, 0.1], atol=1e-12)
    assert graph.chi2() == pytest.approx(6 * 0.01)


def _at(*t: float) -> np.ndarray:
    out = np.zeros((4, 4))
    out[:3, 3] = t
    return out


def test_fixed_vertices_comments_and_order_are_tolerated(tmp_path):
    file = tmp_path / "a.g2o"
    file.write_text(f"# a graph\nPARAMS_SE3OFFSET 0 0 0 0 0 0 0 1\n\nFIX 3\n{EDGE}{VERTICES}")
    graph = read_g2o(file)
    assert graph.ids.tolist() == [3, 7]
    assert graph.edges.tolist() == [[0, 1]]
    assert not graph.loop[0]


@pytest.mark.parametrize(
    ("text", "line", "problem"),
    [
        ("", None, "no vertex"),
        (VERTICES + VERTICES, 3, "vertex 3 is given twice"),
        (VERTICES + EDGE.replace("3 7", "3 8", 1), 3, "vertex 8, which is not there"),
        (VERTICES + EDGE.replace("3 7", "3 3", 1), 3, "joins vertex 3 to itself"),
        (VERTICES + EDGE.replace("1.0", "-1.0", 1), 3, "information matrix is not positive"),
        (VERTICES + EDGE.replace("0.0", "3.0", 1), 3, "information matrix is not positive"),
        (VERTICES + EDGE.replace("1.0", "0.0"), 3, "information matrix is not positive"),
        (VERTICES + EDGE.replace("1.0", "nan", 1), 3, "not finite"),
        (VERTICES.replace("7 1", "7 inf"), 2, "not finite"),
        (VERTICES.replace("0.6", "0.1"), 2, "quaternion has length 0.8062"),
        (VERTICES.replace("0.6 0.8", "0 0"), 2, "quaternion has length 0"),
        (VERTICES.replace("0.6", "x"), 2, "not a number"),
        (VERTICES.replace("QUAT 7", "QUAT 7.5"), 2, "not a number (invalid literal for int"),
        (VERTICES.replace(" 0.8", ""), 2, "has 7 numbers, not 8"),
        (VERTICES + EDGE.rsplit(" ", 1)[0], 3, "has 29 numbers, not 30"),
        (VERTICES + "VERTEX_SE2 1 0 0 0\n", 3, "'VERTEX_SE2'"),
    ],
)
def test_invalid_files_give_one_line_errors(tmp_path, text, line, problem):
    file = tmp_path / "bad.g2o"
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        read_g2o(file)
    message = str(caught.value)
    assert problem in message
    assert message.startswith(f"{file}, line {line}: " if line else f"{file}: ")
    assert "\n" not in message


def test_information_indefinite_by_rounding_is_projected(tmp_path):
    """The nearest positive matrix is used, and the number of such matrices is told."""
    information = np.diag([1e4, 1e4, 1e4, 4e4, 4e4, 4e4])
    information[0, 4] = information[4, 0] = 20000.1  # rounded to six digits; the limit is 2e4
    upper = " ".join(str(v) for v in information[np.triu_indices(6)])
    file = tmp_path / "rounded.g2o"
    start = EDGE.split("0.8")[0] + "0.8 "
    file.write_text(f"{VERTICES}{EDGE}{start}{upper}\n")
    with pytest.warns(InputWarning, match=r"rounded\.g2o: 1 of 2 information matrices is slightly"):
        graph = read_g2o(file)
    assert np.linalg.eigvalsh(graph.information)[1, 0] == pytest.approx(0, abs=1e-9)
    assert np.abs(graph.information[1] - information).max() < 0.1
    write_g2o(tmp_path / "again.g2o", graph)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = read_g2o(tmp_path / "again.g2o")
    np.testing.assert_array_equal(again.information, graph.information)


def test_invalid_graphs_are_not_written(tmp_path):
    graph = some_graph()
    poses = graph.poses.copy()
    poses[1, 0, 0] = np.nan
    with pytest.raises(InputError, match="poses are not all finite"):
        write_g2o(tmp_path / "a.g2o", graph.with_poses(poses))
    with pytest.raises(OutputError, match=r"b\.g2o"):
        write_g2o(tmp_path / "nowhere" / "b.g2o", graph)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "vertices", "edges"), [("sphere", 2500, 9799), ("parking-garage", 1661, 6275)]
)
def test_benchmark_graphs(shared_data, tmp_path, name, vertices, edges):
    source = shared_data / "pose_graphs" / f"{name}.g2o"
    graph = read_g2o(source)
    assert (len(graph.ids), len(graph.edges)) == (vertices, edges)
    assert (~graph.loop).sum() == vertices - 1
    write_g2o(tmp_path / "out.g2o", graph)
    back = read_g2o(tmp_path / "out.g2o")
    np.testing.assert_allclose(back.poses, graph.poses, atol=1e-14)
    np.testing.assert_array_equal(back.information, graph.information)
    # Compared with the numbers in the file.
    first = source.read_text().split("EDGE", 1)[0].splitlines()[:50]
    np.testing.assert_allclose(
        graph.poses[:50, :3, 3], [[float(w) for w in line.split()[2:5]] for line in first]
    )
