"""The coordinates of an array, made once and used for many."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr


class Labels:
    """Dimensions, coordinates and their indexes.

    A response takes less time than xarray's constructor needs for its coordinates (0.3 ms), so that they are put together here by what that
    uses itself; the private names are `_coords`, `_indexes`, `_data` and `fastpath`, and pyproject.toml says up to which xarray they are known. Arrays
    share indexes, which cannot be changed; numbers and attributes of coordinates are each array's own.
    """

    def __init__(self, like: xr.DataArray) -> None:
        self._dims, self._coords, self._indexes = like.dims, like._coords, like._indexes

    def on(self, values: np.ndarray, name: str, attrs: dict[str, Any]) -> xr.DataArray:
        """An array with these labels."""
        coords = {key: self._own(key, one) for key, one in self._coords.items()}
        variable = xr.Variable(self._dims, values, attrs, fastpath=True)
        return xr.DataArray(variable, coords, name=name, indexes=dict(self._indexes), fastpath=True)

    def _own(self, key: Any, one: xr.Variable) -> xr.Variable:
        if key in self._indexes:
            return xr.IndexVariable(one.dims, one._data, dict(one.attrs), fastpath=True)
        return xr.Variable(one.dims, one.values.copy(), dict(one.attrs), fastpath=True)
