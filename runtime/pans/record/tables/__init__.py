"""Recordings as tables: data frames, CSV, Photon-HDF5, Parquet."""

from .export import FILES, write_csv, write_photon_hdf5
from .parquet import need_pyarrow, write_decisions, write_rows
from .tables import to_frame, to_xarray

__all__ = [
    "FILES",
    "need_pyarrow",
    "to_frame",
    "to_xarray",
    "write_csv",
    "write_decisions",
    "write_photon_hdf5",
    "write_rows",
]
