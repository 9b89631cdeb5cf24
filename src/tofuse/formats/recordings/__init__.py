"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.formats.recordings.bags import (
        COLORS,
        ENCODINGS,
        GREY,
        MAX_GAP_S,
        REMEDY,
        BagSource,
        Info,
        Track,
        Transforms,
        bag_kind,
        camera_info,
        cloud,
        color_image,
        decompressed,
        decompressed_color,
        first_message,
        frame_name,
        image,
        lens,
        open_bag,
        open_container,
    )
    from tofuse.formats.recordings.camera_file import (
        AMPLITUDE_KINDS,
        MAX_SLOPE,
        SCHEMA,
        CameraFile,
        ColorCamera,
        camera_fields,
        camera_file_of,
        check_size,
        checked_lens,
        checked_pinhole,
        image_size,
        load_camera,
        number_in,
        numbers_in,
        read_camera_file,
        read_json,
        read_rays,
    )
    from tofuse.formats.recordings.cloud_sequence import (
        MAP_COORDINATES_M,
        CloudFileSource,
        find_shift,
        map_shift,
        note_shift,
        required_files,
        sniff_clouds,
    )
    from tofuse.formats.recordings.correction_file import (
        corrected_depth,
        read_correction,
        write_correction,
    )
    from tofuse.formats.recordings.imu import gravity_at
    from tofuse.formats.recordings.lenses import forward_brown, inverse_brown, simplest_lens
    from tofuse.formats.recordings.native import LENS_COLUMNS, RecordingWriter, same_distortion
    from tofuse.formats.recordings.open import (
        Opening,
        OpeningOptions,
        SingleView,
        is_recording,
        open_recording,
        open_view,
        read_reference,
    )
    from tofuse.formats.recordings.organised import (
        SAMPLES,
        Raster,
        common_camera,
        find_raster,
        organised_frame,
        ray_origin_offset,
    )
    from tofuse.formats.recordings.phones import (
        ARKIT_AXES,
        CONFIDENCE_MAX,
        IMAGE_SIZE,
        SENSOR,
        PhoneSource,
        arkit_pose,
        phone_lens,
        resized,
    )
    from tofuse.formats.recordings.reader import (
        CERTAIN,
        PER_FRAME,
        UNCERTAIN,
        Reader,
        ReaderOptions,
        Sniff,
        begins_with,
        file_of,
        files_at,
        refuse_camera,
        required,
        required_file,
    )
    from tofuse.formats.recordings.rectify import Rectifier, pinhole_of
    from tofuse.formats.recordings.rig import (
        Disagreement,
        Rig,
        RigCamera,
        RigSource,
        read_rig,
        recordings_of,
        rig_file_in,
        write_rig,
    )
    from tofuse.formats.recordings.sources import (
        DepthImageSource,
        FileSource,
        JoinedSource,
        cameras_of,
        check_timestamps,
        cloud_frame,
        finite_float32,
        interpolated,
        library_errors,
        ply_frame,
        poses_from_files,
        poses_of,
        read_matrix_pose,
        read_part,
        sampled_color,
        to_float32,
        tum_poses,
    )
    from tofuse.formats.recordings.still import average_of, change_between, stationary_intervals

__getattr__, __dir__, __all__ = face(__name__, __file__)
