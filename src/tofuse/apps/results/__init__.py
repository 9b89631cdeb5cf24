"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.results.folder import (
        RECORDING,
        RESULT,
        TRACKED,
        Contract,
        OutputFolder,
        check_output,
        claimed,
        component_name,
        component_number,
        finish_interrupted,
        is_result,
        read_json_object,
        result_folder,
    )
    from tofuse.apps.results.loading import load_result, read_cloud, read_mesh
    from tofuse.apps.results.output import CHANGE_COLORS, write_result
    from tofuse.apps.results.pair import LocalView, PairResult, pair_folder, pair_json, write_pair
    from tofuse.apps.results.reopening import (
        StoredRecording,
        locate_recording,
        reopen,
        stored_recordings,
    )
    from tofuse.apps.results.run_json import (
        accuracy_json,
        frame_clock,
        frame_covariance,
        main_poses,
        plain,
        read_run_json,
        reasons_json,
        rotation_up_world,
        run_json_checked,
    )
    from tofuse.apps.results.session_words import (
        MAX_STATED_PROBABILITY,
        probability_text,
        session_sentences,
    )

__getattr__, __dir__, __all__ = face(__name__, __file__)
