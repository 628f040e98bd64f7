"""Rows of a result by their values."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

Row = dict[str, Any]


def where(rows: Iterable[Row], **values: Any) -> list[Row]:
    """Rows that have all these values; a tuple or list means any of them."""

    def fits(row: Row) -> bool:
        return all(row[k] in v if isinstance(v, tuple | list) else row[k] == v for k, v in values.items())

    return [row for row in rows if fits(row)]
