"""The coordinates of an array, made once and used for many."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr


class Labels:
    """Dimensions, coordinates and their indexes.

    A response takes less time than xarray needs to copy the coordinates of an array (0.1 ms), so that they are put together here by what its
    own methods use. Arrays share indexes and numbers of coordinates; neither can be changed in place.
    """

    def __init__(self, like: xr.DataArray) -> None:
        self._like = like
        for one in like.coords.values():
            one.variable.values.setflags(write=False)

    def on(self, values: np.ndarray, name: str, attrs: dict[str, Any]) -> xr.DataArray:
        """An array with these labels."""
        like = self._like
        coords = {key: one if key in like._indexes else _variable(one) for key, one in like._coords.items()}
        variable = xr.Variable(like.dims, values, attrs, fastpath=True)
        return xr.DataArray(variable, coords, name=name, indexes=dict(like._indexes), fastpath=True)


def _variable(one: xr.Variable) -> xr.Variable:
    return xr.Variable(one.dims, one.values, one.attrs, fastpath=True)
