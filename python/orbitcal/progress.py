"""Progress bars in a terminal and in a notebook."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Hear = Callable[[str, int], None]


@contextmanager
def bar(what: str, total: int | None, *, is_shown: bool) -> Iterator[Hear | None]:
    """What work calls with the name of each step and how much is done; `total` is none where it is not known."""
    if not is_shown:
        yield None
        return
    from tqdm.auto import tqdm

    with tqdm(total=total, desc=what, leave=False) as shown:

        def hear(step: str, done: int) -> None:
            shown.set_postfix_str(step, refresh=False)
            shown.n = done if total else shown.n + 1
            shown.refresh()

        yield hear
        if total:  # the work ends between two steps
            shown.n = total
            shown.refresh()
