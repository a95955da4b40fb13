"""Importers of public datasets, by the name of the format."""

from __future__ import annotations

import dataclasses

from data_collection.importers.source import SPLITS, Source, SourceOptions
from envs.errors import UsageError

FORMATS = ("calvin", "omnipush", "dexhand")


def open_source(name: str, options: SourceOptions) -> Source:
    """Open a folder in a public layout.

    Raises:
        UsageError: no such format, or the folder is not in it.
    """
    # `.` and a link tell neither the name of the split nor what is beside it.
    path = options.path.absolute() if options.path.name in SPLITS else options.path.resolve()
    options = dataclasses.replace(options, path=path)
    if name == "calvin":
        from data_collection.importers.calvin import open_calvin

        return open_calvin(options)
    if name == "omnipush":
        from data_collection.importers.omnipush import open_omnipush

        return open_omnipush(options)
    if name == "dexhand":
        from data_collection.importers.dexhand import open_dexhand

        return open_dexhand(options)
    raise UsageError(f"no format named '{name}'; choose one of {', '.join(FORMATS)}")


__all__ = ["FORMATS", "Source", "SourceOptions", "open_source"]
