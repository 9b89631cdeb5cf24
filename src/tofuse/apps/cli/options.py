"""The commands and their options, from which the parser and its ``--help`` are made.

A class is a command, and its docstring is its help page: the summary, remarks, options with the
placeholders of their values, further groups of options, and the exit status. A field without a
default is an argument, one with `REQUIRED` an option that can't be left out.

Imports nothing heavy, so that ``--help`` is instant.
"""

import argparse
from pathlib import Path
from typing import Any, Literal

from tofuse.apps.cli.values import (
    Count,
    Depth,
    Factor,
    Length,
    Metres,
    NonNegative,
    Planes,
    Port,
    Ratio,
    Seconds,
    Size,
)

REQUIRED: Any = ...
_LAB = "tofuse.lab.commands"

DemoScene = Literal["room", "empty-room", "rail", "torso", "box", "peaks"]


class Command(argparse.Namespace):
    """Base of the commands."""

    home = "tofuse.apps.cli.commands"  # module of its function, imported when it runs
    reconstructs = False  # whether kernels are compiled while it starts
    exclusive: tuple[str, ...] = ()  # options of which only one may be given
    subcommands: tuple[type["Command"], ...] = ()


class Threads(Command):
    """Parallelism.

    Attributes
    ----------
    threads : N
        threads (default: all cores)
    """

    threads: Count | None = None


class Seed(Command):
    """Randomness.

    Attributes
    ----------
    seed : N
        random seed (default: 0)
    """

    seed: NonNegative | None = None


class Json(Command):
    """Machine-readable output.

    Attributes
    ----------
    json
        print the result as JSON
    """

    json: bool = False


class Written(Command):
    """A result that is printed, and written if there is a folder for it.

    Attributes
    ----------
    out : DIR
        folder for the result (default: only print)
    overwrite
        replace an existing result in --out
    """

    out: Path | None = None
    overwrite: bool = False


class Edited(Command):
    """Results that were edited.

    Attributes
    ----------
    edited
        accept results whose files were edited
    """

    edited: bool = False


class JsonLines(Command):
    """Machine-readable output while it is made.

    Attributes
    ----------
    json
        progress and result as JSON lines
    """

    json: bool = False


class Source(Command):
    """How recordings are opened.

    Input
    -----
    format : F
        input format, if not recognised
    camera : FILE
        camera.json, or a calibration file of OpenCV, ROS, ..., instead of the recording's own
    topic : T
        topic of a ROS bag, or stream of a .h5 file (default: chosen automatically)
    """

    format: str | None = None
    camera: Path | None = None
    topic: str | None = None


class Scaled(Source):
    """How recordings in another unit are opened.

    Input
    -----
    factor : F
        multiply depth, or the points and poses of clouds, by F, such as 0.001 if they are in mm
    """

    factor: Factor | None = None


class Selection(Scaled):
    """Which frames are read.

    Input
    -----
    start : I
        first frame (default: 0)
    end : I
        stop before this frame
    every : N
        use every N-th frame
    """

    start: int = 0
    end: int | None = None
    every: Count = 1


class Page(Command):
    """Where a page is shown.

    Browser
    -------
    port : N
        port (default: 8080, or the next free one)
    no_open
        do not open the browser
    """

    port: Port | None = None
    no_open: bool = False


class Run(JsonLines, Seed, Threads, Page, Selection):
    """Reconstruct a recording.

    Attributes
    ----------
    inputs : INPUT
        recordings, joined in this order
    out : DIR
        folder for the result
    overwrite
        replace an existing result in --out
    no_report
        don't draw report.html, which takes up to half of a short run
    share
        also write share.html and share.usdz: the model alone, to send and for AR
    mirrors
        find mirrors, and cut the rooms behind them out of the model (experimental)
    texture
        texture the surface in mesh.glb and in the report, from colour images or else amplitudes
        (default: if there are enough colour images)
    faces : N
        maximum number of triangles, slightly exceeded if so few left no surface
        (default: all)
    voxel : LENGTH
        resolution of the model, e.g. 5mm (default: from the camera's resolution)
    memory : SIZE
        approximate memory limit, e.g. 4GB; the rest goes to disk (default: 2GB)
    rig : FILE
        a rig.json; each INPUT is one of its cameras, in the same order
    profile
        print how long each stage of the process took

    Reconstruction
    --------------
    method : NAME
        configuration: default or thesis (default: default)
    config : FILE
        options from a .toml file, or from the run.json of an earlier result
    guess
        initial guess of each registration (default: previous)
    moving
        exclude moving objects from tracking and model (default), or ignore that anything may move,
        in a scene that is certainly static
    prior
        measurements to use, as far as they agree with the images: gravity and a phone's own poses
        (auto, the default), none, or recorded odometry as well (device)
    loops : FILE
        known loop closures, one `i j` per line
    object
        turntable mode: an object turns in front of a static camera
    unwrap
        unwrap phase beyond the camera's ambiguity range
    tolerance : LENGTH
        accuracy required of a "good" result, e.g. 30mm (default: 0.5 % of the model, at least 10mm)

    Browser
    -------
    view
        show the reconstruction live, and then the result

    Input
    -----
    average_still
        average static segments into one frame each
    min_depth : M
        discard points closer than this
    max_depth : M
        discard points farther than this

    Exit status
    -----------
    0  a result was written and every readable frame has a pose
    3  a result was written, but some readable frame has no pose
    2  nothing was written: one line on stderr states the reason
    """

    reconstructs = True

    inputs: list[str]
    out: Path = REQUIRED
    overwrite: bool = False
    no_report: bool = False
    share: bool = False
    mirrors: bool = False
    texture: bool | None = None
    faces: Count | None = None
    voxel: Length | None = None
    memory: Size | None = None
    rig: Path | None = None
    profile: bool = False
    method: str | None = None
    config: Path | None = None
    guess: Literal["identity", "previous", "odometry"] | None = None
    moving: Literal["exclude", "ignore"] | None = None
    prior: Literal["auto", "none", "device"] = "auto"
    loops: Path | None = None
    object: bool = False
    unwrap: bool = False
    tolerance: Length | None = None
    view: bool = False
    average_still: bool = False
    min_depth: Depth | None = None
    max_depth: Depth | None = None


class Batch(Command):
    """Reconstruct many recordings, each as a separate job.

    A list is a text file with one path or glob per line, or a table (.csv) with a column
    `recording` and further columns for options of `tofuse run`; see docs/batch.md. Run the same
    command again to resume.

    Attributes
    ----------
    recordings : LIST
        a list of recordings, a recording, or a glob
    out : DIR
        folder for the results
    overwrite
        replace results made with other options; up-to-date results are kept
    json
        jobs and outcome as JSON lines
    only : NAME
        run only this job; may be repeated
    print_jobs
        only print one command per job

    Workers
    -------
    workers : N
        parallel jobs on this machine (default: 1)
    scheduler : ADDRESS
        Dask scheduler: tcp://HOST:8786, or its scheduler file
    threads : N
        threads per job (default: all cores shared by the jobs; on Dask: 1)
    retries : N
        how often a job whose process was killed is restarted (default: 3)

    Exit status
    -----------
    0  every recording has a result, and every readable frame has a pose
    3  some recording has no result, or some readable frame has no pose
    2  there is no result: one line on stderr states the reason
    """

    home = "tofuse.apps.cli.batching"
    exclusive = ("workers", "scheduler")

    recordings: list[Path]
    out: Path = REQUIRED
    overwrite: bool = False
    json: bool = False
    only: list[str] | None = None
    print_jobs: bool = False
    workers: Count | None = None
    scheduler: str | None = None
    threads: Count | None = None
    retries: NonNegative | None = None


class Register(Written, Json, Threads, Source):
    """Register two files or frames.

    A view is a file with a single view (PLY, PCD, LAS, LAZ, E57, ...), a mesh (PLY, OBJ, STL,
    GLB), a result, or REC#12: frame 12 of a recording, counting from 0.

    Attributes
    ----------
    source : SOURCE
        the view to be transformed
    target : TARGET
        the view that stays fixed
    guess : FILE
        initial guess of T_target_source
    method : NAME
        registration method, such as icp (default: any-pair)
    scale
        estimate the unknown scale of the source, as of a model from images alone
    factor : F
        multiply the source's coordinates by F, such as 0.001 for a file in mm
    risk : P
        largest probability that an accepted pose is wrong, up to 0.1 (default: 0.1)

    Exit status
    -----------
    0  the pose is accepted
    3  the pose is rejected, or cannot be verified; it is still printed and written
    2  nothing was written: one line on stderr states the reason
    """

    source: str
    target: str
    guess: Path | None = None
    method: str | None = None
    scale: bool = False
    factor: Factor | None = None
    risk: float = 0.1


class Judge(Written, Json, Threads, Selection):
    """Assess poses from any source, without a reference.

    Attributes
    ----------
    recording : RECORDING
        range images
    trajectory : TRAJECTORY
        a trajectory in any supported format, a result, or a recording with poses
    out : DIR
        folder for the refined result (default: only print)
    tolerance : LENGTH
        accuracy required of good poses, e.g. 30mm (default: 0.5 % of the model, at least 10mm)
    scale
        estimate the scale of the poses from the depth (default: only if they can't be in metres)

    Exit status
    -----------
    0  the poses were assessed
    3  the depth images contradict the poses
    2  nothing was assessed: one line on stderr states the reason
    """

    reconstructs = True

    recording: str
    trajectory: Path
    tolerance: Length | None = None
    scale: bool = False


class Merge(JsonLines, Seed, Threads, Edited):
    """Merge the results of several recordings into one map.

    A RESULT is the --out of `tofuse run` or `tofuse merge`; its recording must still be where it
    was. The first result defines the world frame. What cannot be joined stays a separate component.

    Attributes
    ----------
    results : RESULT
        two or more results; the first one defines the world frame
    out : DIR
        folder for the map
    overwrite
        replace an existing result in --out
    tolerance : LENGTH
        accuracy required of a "good" map, e.g. 30mm (default: as the first result)
    texture
        texture the surface (default: as the first result)
    faces : N
        maximum number of triangles, slightly exceeded if so few left no surface
        (default: as the first result)
    voxel : LENGTH
        resolution of the model, e.g. 5mm (default: as the first result)

    Exit status
    -----------
    0  a result was written and every readable frame is in one map
    3  a result was written, but a session or a frame could not be joined
    2  nothing was written: one line on stderr states the reason
    """

    reconstructs = True

    results: list[Path]
    out: Path = REQUIRED
    overwrite: bool = False
    tolerance: Length | None = None
    texture: bool | None = None
    faces: Count | None = None
    voxel: Length | None = None


class Locate(Written, Json, Threads, Edited, Selection):
    """Locate a frame, a clip or a cloud in a finished result.

    RESULT is the --out of `tofuse run` or `tofuse merge`; its recording must still be where it was.
    INPUT is a recording, one frame of it (REC#12), or a cloud.

    Attributes
    ----------
    result : RESULT
        the map
    input : INPUT
        what is to be located
    out : DIR
        folder for the poses (default: only print)

    Exit status
    -----------
    0  every frame has an accepted pose in the map
    3  the pose of some frame is not accepted; poses are still printed and written
    2  nothing was written: one line on stderr states the reason
    """

    reconstructs = True

    result: Path
    input: str


class Compare(Written, Json, Threads, Edited):
    """Compare a result with a CAD model, a mesh, a cloud or another result.

    Both are registered, and the result's deviation from the reference's surface is mapped, with its
    uncertainty. The tolerance is decided by the rules of ISO 14253-1.

    Attributes
    ----------
    result : RESULT
        a result, or a mesh or cloud (PLY, STL, OBJ, GLB, E57, ...)
    reference : REFERENCE
        what it should be: a file or result of the same kinds
    tolerance : LENGTH
        largest deviation allowed, to either side, e.g. 2mm
    accuracy : LENGTH
        95 % bound on errors that neighbouring points share (default: as the result states)
    guess : FILE
        initial guess of T_reference_result
    unit
        unit of the reference's file (default: m or mm, by its extent)
    out : DIR
        folder for the map of deviations and the report (default: only print)

    Exit status
    -----------
    0  everything seen is within the tolerance, or no tolerance was given
    3  something is outside the tolerance
    4  undecided: too close to the tolerance, or the registration is not accepted
    2  nothing was written: one line on stderr states the reason
    """

    home = "tofuse.apps.cli.comparing"

    result: str
    reference: str
    tolerance: Length | None = None
    accuracy: Length | None = None
    guess: Path | None = None
    unit: Literal["mm", "cm", "m", "in"] | None = None


class Repeat(Written, Json, Threads, Edited):
    """Compare results of the same place: repeatability, and whether their bounds hold.

    Results in the same folder are of one session.

    Attributes
    ----------
    results : RESULT
        two or more results; the first one is the reference
    out : DIR
        folder for the tables (default: only print)

    Exit status
    -----------
    0  the results were compared
    2  nothing was written: one line on stderr states the reason
    """

    home = "tofuse.apps.cli.comparing"

    results: list[Path]


class Card(Written, Json, Edited):
    """Follow one camera over its results, and test whether it drifts.

    Attributes
    ----------
    results : RESULT
        results of one camera; their recordings must still be at their paths
    out : DIR
        folder for card.html and card.json (default: only print)

    Exit status
    -----------
    0  no quantity changes with time by more than its uncertainty
    3  a quantity changes with time
    2  nothing was written: one line on stderr states the reason
    """

    home = "tofuse.apps.cli.comparing"

    results: list[Path]


class RigOptions(Json, Threads):
    """Options of the commands of rigs.

    Attributes
    ----------
    motion
        whether the cameras are static (default: detected from the images)
    format : F
        input format, if not recognised
    topic : T
        of bags: the topic of the depth images, if not recognised
    """

    home = "tofuse.apps.cli.rigging"

    motion: Literal["auto", "still", "moving"] = "auto"
    format: str | None = None
    topic: str | None = None


class RigCalibrate(RigOptions):
    """Estimate the extrinsics of a rig.

    Pass one recording per camera, taken at the same time: a single image each, images of a
    scene in which something moves, or a walk with the rig. The first camera defines the rig
    frame.

    Attributes
    ----------
    inputs : RECORDING
        one per camera
    out : FILE
        the rig.json to write
    overwrite
        replace an existing FILE

    Exit status
    -----------
    0  the pose of every camera was found
    3  the file was written, but the pose of some camera could not be found
    2  nothing was written: one line on stderr states the reason
    """

    inputs: list[str]
    out: Path = REQUIRED
    overwrite: bool = False


class RigCheck(RigOptions):
    """Check whether a camera has moved since the rig was calibrated.

    Attributes
    ----------
    rig : RIG
        a rig.json
    inputs : RECORDING
        new recordings of its cameras, in the same order

    Exit status
    -----------
    0  no camera has moved
    3  some camera has moved, or cannot be checked
    2  nothing could be checked: one line on stderr states the reason
    """

    rig: Path
    inputs: list[str]


class Rig(Command):
    """Calibrate or check a rig of several cameras.

    A rig is several rigidly mounted depth cameras.
    """

    subcommands = (RigCalibrate, RigCheck)


class Demo(JsonLines, Seed, Threads):
    """Simulate a recording and reconstruct it.

    The recording is left in DIR/recording, the result in DIR.

    Attributes
    ----------
    scene
        what to simulate (default: room)
    failure
        simulate a recording that can't be reconstructed, 1.5 m along a bare corridor: report.html
        shows how the failure is detected and explained
    out : DIR
        output folder (default: tofuse-demo)
    overwrite
        replace an existing demo in DIR
    method : NAME
        configuration: default or thesis (default: default)

    Exit status
    -----------
    0  a result was written and every readable frame has a pose
    3  a result was written, but some readable frame has no pose
    2  nothing was written: one line on stderr states the reason
    """

    home = _LAB
    reconstructs = True
    exclusive = ("scene", "failure")

    scene: DemoScene = "room"
    failure: bool = False
    out: Path = Path("tofuse-demo")
    overwrite: bool = False
    method: str | None = None


class Simulate(Seed, Threads):
    """Simulate a recording.

    Attributes
    ----------
    scene : SCENE
        room, empty-room, rail, torso, box, peaks, wall, corner, flat, flat-alike, hall, corridor,
        checkerboard
    out : DIR
        output folder
    camera : NAME
        camera model, or `phone` (default: sr4000)
    every : N
        use every N-th raw frame (default: as in the thesis; 6 for a phone)
    frames : N
        stop after this many frames
    first : K
        first raw frame (0)
    uniform
        uniform albedo, no texture
    with_person : RATIO
        a person walks through the view, covering this fraction of it, 0 to 1
    with_box : RATIO
        a box slides through the view, covering this fraction of it, 0 to 1
    mirror : WxH
        a mirror of this size in m hangs on a wall in view, e.g. 0.8x1.2
    without : EFFECTS
        sensor errors to disable, separated by commas, or `all`
    no_correction
        omit the factory depth correction
    imu
        simulate an accelerometer as well
    sigma : M
        noise of the `peaks` scene, m (default: 0.05)
    """

    home = _LAB
    exclusive = ("with_person", "with_box")

    scene: str
    out: Path = REQUIRED
    camera: str = "sr4000"
    every: Count | None = None
    frames: Count | None = None
    first: NonNegative | None = None
    uniform: bool = False
    with_person: Ratio | None = None
    with_box: Ratio | None = None
    mirror: str | None = None
    without: str = ""
    no_correction: bool = False
    imu: bool = False
    sigma: Metres | None = None


class Plan(Json, Seed, Threads, Edited):
    """Predict which cameras would reach a tolerance, from a coarse scan of the place.

    Each camera is simulated along the path in the scan's model, and what it records is
    reconstructed.

    Attributes
    ----------
    result : RESULT
        a result of the scan
    camera : NAME
        simulated camera; may be repeated (default: all)
    path : FILE
        trajectory in the world of the scan (default: its own)
    tolerance : LENGTH
        required 95 % bound on the positions of the camera (default: 5mm)

    Exit status
    -----------
    0  some camera would reach the tolerance
    3  none would
    4  undecided: too close to the tolerance
    2  nothing was simulated: one line on stderr states the reason
    """

    home = _LAB
    reconstructs = True

    result: Path
    camera: list[str] | None = None
    path: Path | None = None
    tolerance: Length = 0.005


class Inspect(Json, Scaled):
    """Show a recording's properties and check it for faults.

    Attributes
    ----------
    inputs : INPUT
        recordings, joined in this order
    object
        an object turns in front of a static camera
    quick
        check fewer frames, as `tofuse run` does first
    """

    inputs: list[str]
    object: bool = False
    quick: bool = False


class Convert(Selection):
    """Write any recording as a native, TUM or Open3D folder.

    Attributes
    ----------
    inputs : INPUT
        recordings, joined in this order
    out : DIR
        a new folder
    to
        layout of the folder (default: native; the others cannot store everything)
    """

    inputs: list[str]
    out: Path = REQUIRED
    to: Literal["native", "tum", "open3d"] = "native"


class Record(Page):
    """Record from a connected camera.

    Attributes
    ----------
    device : CAMERA
        camera name; omit to list available cameras
    out : DIR
        a new folder for the recording
    seconds : S
        stop after this time
    frames : N
        stop after this many frames
    set : NAME=VALUE
        camera option, e.g. serial=1234; may be repeated
    view
        show a map of the frames so far, and where to look next
    """

    device: str | None
    out: Path | None = None
    seconds: Seconds | None = None
    frames: Count | None = None
    set: list[str] | None = None
    view: bool = False


class Calibrate(Json, Seed, Selection):
    """Estimate intrinsics or depth errors of a camera, or import intrinsics.

    lens: from views of a checkerboard, writes a camera.json.
    depth: from views of planes, writes a correction.npz.
    import: from a file of OpenCV, ROS, Kalibr, Open3D or ORB-SLAM, writes a camera.json.

    Attributes
    ----------
    subject
        what to calibrate
    inputs : INPUT
        recordings; import: one file
    out : FILE
        file for the result (default: only print)
    overwrite
        replace an existing FILE

    Lens and depth
    --------------
    board : CxR:M
        inner corners and square size in metres, e.g. 8x6:0.1
    image
        image in which to detect the board (default: amplitude)

    Depth
    -----
    wall
        the board is flat on a wall; use the whole wall
    planes : N
        without --board: maximum planes per view (default: 4)

    Lens
    ----
    model
        distortion model (default: brown)

    Import
    ------
    recording : REC
        take depth unit and kind from this recording
    """

    home = "tofuse.apps.cli.calibrating"

    subject: Literal["lens", "depth", "import"]
    inputs: list[str]
    out: Path | None = None
    overwrite: bool = False
    board: str | None = None
    image: Literal["amplitude", "color"] = "amplitude"
    wall: bool = False
    planes: Planes = 4
    model: Literal["pinhole", "brown", "rational", "fisheye"] = "brown"
    recording: str | None = None


class Noise(Json, Scaled):
    """Estimate a camera's noise from a static recording.

    Attributes
    ----------
    inputs : INPUT
        recordings, joined in this order
    out : FILE
        file for the noise model, e.g. noise.json (default: only print)
    overwrite
        replace an existing FILE
    name : NAME
        name of the camera
    """

    home = "tofuse.apps.cli.calibrating"

    inputs: list[str]
    out: Path | None = None
    overwrite: bool = False
    name: str | None = None


class Evaluate(Json, Edited):
    """Compare a trajectory with a reference.

    Attributes
    ----------
    estimate : ESTIMATE
        a trajectory or a result
    reference : REFERENCE
        a trajectory, or a recording that comes with reference poses
    recording : REC
        also measure the map consistency of its images
    reference_error : LENGTH
        rms error of the reference itself, e.g. 20mm; prints an interval for the ATE
    """

    estimate: Path
    reference: Path
    recording: Path | None = None
    reference_error: Length | None = None


class Optimize(Json):
    """Optimise a pose graph.

    Attributes
    ----------
    input : IN.g2o
        the pose graph
    out : OUT.g2o
        the optimised pose graph
    optimiser : NAME
        castellani, lu-milios, elch, stochastic or levenberg-marquardt (the default)
    robust : KERNEL
        against false loops, for levenberg-marquardt: truncated, huber, cauchy, geman-mcclure, dcs
        or switchable (default: none, plain least squares)
    overwrite
        replace an existing OUT.g2o
    """

    input: Path
    out: Path = REQUIRED
    optimiser: str | None = None
    robust: str | None = None
    overwrite: bool = False


class Export(Edited):
    """Write a result in other formats.

    Attributes
    ----------
    result : DIR
        a result: the --out of `tofuse run`
    formats : FORMAT
        pcd, las, laz, e57, glb, gltf, obj, usdz, stl, kitti, log, nerfstudio, colmap, rerun,
        mcap, occupancy, esdf, octomap
    out : DIR
        folder for the files (default: that of the result)
    faces : N
        maximum number of triangles (default: 60000; STL: all)
    every : N
        every N-th frame (nerfstudio, colmap, rerun, mcap, occupancy, esdf, octomap)
    pinhole
        images without distortion (nerfstudio, colmap)
    voxel : LENGTH
        voxel size (occupancy, esdf, octomap; default: a 400th of the model's diagonal)
    overwrite
        replace existing files
    """

    result: Path
    formats: list[str]
    out: Path | None = None
    faces: Count | None = None
    every: Count = 1
    pinhole: bool = False
    voxel: Length | None = None
    overwrite: bool = False


class Experiments(Seed, Threads):
    """Reproduce the experiments of the 2010 thesis.

    Attributes
    ----------
    out : DIR
        folder for the report
    overwrite
        replace existing experiments in DIR
    cases : NAMES
        run only these, separated by commas
    seeds : N
        noise seeds (default: 20)
    """

    home = _LAB

    out: Path = REQUIRED
    overwrite: bool = False
    cases: str = ""
    seeds: Count = 20


class View(Page, Edited):
    """Show a result in the browser.

    Attributes
    ----------
    result : DIR
        a result: the --out of `tofuse run`
    """

    result: Path


COMMANDS: tuple[type[Command], ...] = (
    *(Run, Batch, Register, Judge, Merge, Locate, Compare, Repeat, Card, Rig, Demo, Simulate, Plan),
    *(Inspect, Convert, Record, Calibrate, Noise, Evaluate, Optimize, Export, Experiments, View),
)
