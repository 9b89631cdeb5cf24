"""Lists of jobs: text and tables, names, invalid lists."""

from __future__ import annotations

from pathlib import Path

import pytest

from tofuse.apps.batch.jobs import Job, read_jobs
from tofuse.apps.cli.run_arguments import run_arguments
from tofuse.engine.errors import InputError


def jobs_of(folder: Path, text: str, name: str = "list.txt") -> tuple[Job, ...]:
    path = folder / name
    path.write_text(text)
    return read_jobs([path], run_arguments)


@pytest.fixture
def recordings(tmp_path: Path) -> Path:
    for name in ("a/frames9", "a/frames10", "b/frames9", "c#1/recording"):
        (tmp_path / name).mkdir(parents=True)
    return tmp_path


def test_list_lines_are_relative_paths_and_globs(recordings: Path) -> None:
    found = jobs_of(
        recordings, "# two\na/frames*   # of a\n\nb/frames9\n/x/y z.bag\nc#1/recording\n"
    )
    paths = [recordings / name for name in ("a/frames9", "a/frames10", "b/frames9")]
    assert [job.recording for job in found] == [
        *map(str, paths),
        "/x/y z.bag",
        f"{recordings}/c#1/recording",
    ]
    assert [job.name for job in found] == ["frames9", "frames10", "b-frames9", "y_z.bag", "c_1"]
    assert all(job.arguments == () for job in found)


def test_names_are_stable_when_list_grows(recordings: Path) -> None:
    before = jobs_of(recordings, "a/frames9\n")
    assert jobs_of(recordings, "a/frames9\nb/frames9\n")[0] == before[0]


def test_table_sets_options_per_job(recordings: Path) -> None:
    text = (
        "recording,name,every,max-depth,object,config\n"
        "a/frames9,,2,,yes,c.toml\na/frames9,far,,4.5,no,\n"
    )
    one, other = jobs_of(recordings, text, "list.csv")
    assert set(one.arguments) == {"--every=2", "--object", f"--config={recordings / 'c.toml'}"}
    assert one.name == "frames9"
    assert other == Job("far", one.recording, ("--max-depth=4.5",))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("list.txt", "# nothing\n", "lists no recording"),
        ("list.txt", "a/nothing*\n", "line 1: nothing matches a/nothing*"),
        ("list.txt", "a\0b\n", "line 1: contains a NUL"),
        ("notes.txt", "Recorded on Monday.\n", "but none exists, such as 'Recorded on Monday.'"),
        ("list.csv", "", "lists no recording"),
        ("list.csv", "path\na\n", "row 1: names no recording"),
        ("list.csv", "recording,recording\na,b\n", "name each column once"),
        ("list.csv", "recording,every\na\n", "row 1: has 1 cell, but there are 2 columns"),
        ("list.csv", 'recording\n"a\n', "is not a table"),
        ("list.csv", "recording,evry\na,2\n", "for a table; did you mean every?"),
        ("list.csv", "recording,out\na,b\n", "row 1: out is not an option"),
        ("list.csv", "recording,threads\na,1\n", "row 1: threads is not an option"),
        ("list.csv", "recording,every\na,none\n", "row 1: argument every: 'none' is not"),
        ("list.csv", "recording,object\na,perhaps\n", "row 1: object is 'perhaps'; use yes or no"),
        ("list.csv", "recording,name\na,../b\n", "row 1: '../b' can't be used as the name"),
        ("list.csv", "recording,name\na,jobs\n", "row 1: 'jobs' can't be used as the name"),
        ("list.csv", "recording,name\na,x\nb,X\n", "row 2: the name X is used twice"),
        ("list.csv", "recording,name\na/*,x\n", "a/* matches 2 recordings, but there is one name"),
    ],
)  # fmt: skip
def test_invalid_lists_are_rejected(name: str, text: str, message: str, recordings: Path) -> None:
    with pytest.raises(InputError) as caught:
        jobs_of(recordings, text, name)
    assert message in str(caught.value)
    assert str(caught.value).startswith(str(recordings / name))


def test_recordings_globs_and_lists_are_given_together(recordings: Path, monkeypatch) -> None:
    """Arguments are relative to the current folder, lines of a list to that of the list."""
    monkeypatch.chdir(recordings / "a")
    (recordings / "one.bag").write_bytes(b"#ROSBAG\0")
    (recordings / "list").write_text("b/*\na/frames9\n")
    given = map(Path, ("frames9", "frames1*", "../one.bag", "../list"))
    found = read_jobs(list(given), run_arguments)
    assert [job.name for job in found] == ["frames9", "frames10", "one.bag", "b-frames9"]
    assert [Path(job.recording).resolve() for job in found] == [
        recordings / name for name in ("a/frames9", "a/frames10", "one.bag", "b/frames9")
    ]


def test_job_key_depends_on_recording_and_options(tmp_path: Path) -> None:
    out = tmp_path / "out"
    bag, other = tmp_path / "one.bag", tmp_path / "two.bag"
    for path in (bag, other):
        path.write_bytes(b"1")
    job = Job("one", str(bag))
    key = job.key(out)
    assert Job("other", str(bag)).key(out) == key
    assert Job("one", str(bag), ("--seed=1",)).key(out) != key
    assert Job("one", str(other)).key(out) != key
    other.write_bytes(b"another recording")
    (tmp_path / "three.bag").write_bytes(b"2")
    assert job.key(out) == key
    (tmp_path / "camera.json").write_text("{}")
    assert job.key(out) != key
    config = tmp_path / "c.toml"
    config.write_text("")
    configured = Job("one", str(bag), (f"--config={config}",))
    before = configured.key(out)
    config.write_text("seed = 1")
    assert configured.key(out) != before
    folder = Job("all", str(tmp_path))
    before = folder.key(out)
    out.mkdir()
    (out / "batch.csv").write_text("")
    assert folder.key(out) == before
    assert Job("none", "/nothing").key(out)
