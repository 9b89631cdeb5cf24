"""Many recordings, each reconstructed by a process of its own.

A list gives jobs, workers on this machine or on a Dask cluster do them, and a folder records what
became of each, so that the same command resumes where an earlier one stopped.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.batch.batch import pending, run_batch, status_of
    from tofuse.apps.batch.cluster import DaskWorkers
    from tofuse.apps.batch.folder import BatchFolder, Record
    from tofuse.apps.batch.jobs import Job, read_jobs
    from tofuse.apps.batch.table import write_table
    from tofuse.apps.batch.work import LocalWorkers, Workers

__getattr__, __dir__, __all__ = face(__name__, __file__)
