"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.formats.files.atomic import (
        UNFINISHED,
        make_folder,
        replacing,
        write_bytes,
        write_text,
    )
    from tofuse.formats.files.e57 import write_e57
    from tofuse.formats.files.exr import parse_exr
    from tofuse.formats.files.g2o import read_g2o, write_g2o
    from tofuse.formats.files.given_loops import read_loops
    from tofuse.formats.files.glb import write_glb, write_gltf
    from tofuse.formats.files.images import (
        as_color,
        check_first_size,
        first_size,
        jpeg_bytes,
        parse_image,
        png_bytes,
        read_color,
        read_header,
        read_image,
        read_raw,
        write_png,
    )
    from tofuse.formats.files.las import write_las, write_laz
    from tofuse.formats.files.locking import Claim, locked
    from tofuse.formats.files.lzfse import lzfse_decompress
    from tofuse.formats.files.matroska import MAGIC, Block, Matroska, Track
    from tofuse.formats.files.noise_file import read_noise, write_noise
    from tofuse.formats.files.npz import Arrays, read_npz
    from tofuse.formats.files.obj import write_obj
    from tofuse.formats.files.pcd import Pcd, read_pcd, write_pcd
    from tofuse.formats.files.pcic import BEGIN, Chunk, chunk_image, pcic_frames
    from tofuse.formats.files.pgm import parse_pgm
    from tofuse.formats.files.ply import read_ply, write_ply
    from tofuse.formats.files.pose import pose_text, read_pose
    from tofuse.formats.files.reading import (
        damage_reported,
        files_named,
        files_with,
        if_file,
        input_error,
        is_file,
        is_folder,
        list_folder,
        name_order,
        parse_toml,
        parsed,
        path_of,
        read_bytes,
        read_head,
        read_text,
        required_package,
    )
    from tofuse.formats.files.staging import (
        StagedFolder,
        beside,
        finish_replacing,
        is_interrupted,
        new_folder,
        replacing_folder,
    )
    from tofuse.formats.files.stamps import stamp, stamps_of
    from tofuse.formats.files.tables import (
        exact,
        parse_numbers,
        read_columns,
        read_numbers,
        write_columns,
    )
    from tofuse.formats.files.tiff import read_tiff
    from tofuse.formats.files.trajectory import (
        associate,
        associated_poses,
        read_tum,
        write_kitti,
        write_log,
        write_tum,
    )
    from tofuse.formats.files.trajectory_formats import OPENGL, Clock, TimedPoses, read_poses
    from tofuse.formats.files.video import Video

__getattr__, __dir__, __all__ = face(__name__, __file__)
