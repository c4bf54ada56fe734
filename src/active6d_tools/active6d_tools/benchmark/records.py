"""Results of single views in a JSON-lines file, so that an interrupted benchmark continues where it stopped."""

import json
from collections.abc import Hashable
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from active6d_core.files import append_line, write_file
from active6d_perception.estimators.single_view_evaluation import ViewResult

_INTEGERS = {"hypothesis", "object"}
_PLAIN = {"width", "seconds", "cpu_seconds", "stage_ms"}


class Records:
    """Results by key; only in memory if there is no path."""

    def __init__(self, path: Path | None, header: dict[str, Any]) -> None:
        """
        Args:
            path: read if it exists, and appended to.
            header: settings of all results; a file with another header is refused.

        Raises:
            ValueError: the file is damaged or has results of other settings; the message names it.
        """
        self._path = path
        self._results: dict[Hashable, ViewResult] = {}
        if path is None:
            return
        if path.is_file():
            self._read(path, header)
        else:
            write_file(path, json.dumps(header) + "\n")

    def __contains__(self, key: Hashable) -> bool:
        return key in self._results

    def __getitem__(self, key: Hashable) -> ViewResult:
        return self._results[key]

    def add(self, key: Hashable, result: ViewResult) -> None:
        """Keep a result, on disk before this returns."""
        self._results[key] = result
        if self._path is not None:
            entry = {
                name: np.round(value, 7).tolist() if isinstance(value, np.ndarray) else value
                for name, value in asdict(result).items()
            }
            append_line(self._path, json.dumps({"key": key, **entry}))

    def _read(self, path: Path, header: dict[str, Any]) -> None:
        text = path.read_text()
        whole = text[: text.rfind("\n") + 1]
        try:
            first, *entries = [json.loads(line) for line in whole.splitlines()]
            if first.keys() != header.keys():
                raise ValueError("its first line does not hold the settings; choose another file")
            if first != header:
                raise ValueError(f"its settings are {first}, the current ones {header}; choose another file")
            for entry in entries:
                self._results[tuple(entry["key"])] = _result(entry)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path}: cannot continue with these records ({error})") from error
        if whole != text:  # the last line is incomplete: writing was interrupted
            write_file(path, whole)


def _result(entry: dict[str, Any]) -> ViewResult:
    values: dict[str, Any] = {}
    for name in (item.name for item in fields(ViewResult)):
        dtype = int if name in _INTEGERS else float
        values[name] = entry[name] if name in _PLAIN else np.array(entry[name], dtype)
    return ViewResult(**values)
