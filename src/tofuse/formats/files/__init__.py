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
    from tofuse.formats.files.locking import Claim, locked
    from tofuse.formats.files.noise_file import read_noise, write_noise
    from tofuse.formats.files.npz import Arrays, read_npz
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

__getattr__, __dir__, __all__ = face(__name__, __file__)
