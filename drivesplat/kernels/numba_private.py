"""numba's cache on disk behind one function of ours, which sets a private attribute. tests/kernels/test_private.py
checks it.

There is no public way to choose the class of the cache.
"""

from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from numba.core.caching import FunctionCache

from drivesplat.io.file_lock import waiting_for_lock


class SharedCache(FunctionCache):
    """A cache that processes may fill at the same time.

    numba numbers the files of a function's signatures by its index. Without the lock two processes that compile
    different signatures write the same file and lose an entry of the index, and other processes load the wrong code.
    """

    def save_overload(self, sig: Any, data: Any) -> None:
        with ExitStack() as held:
            with suppress(OSError):  # a file system without locks, or a lock file of another user
                held.enter_context(waiting_for_lock(Path(self.cache_path) / "lock"))
            super().save_overload(sig, data)


def cached_on_disk(dispatcher: Any) -> Any:
    """A compiled function, from now on with a cache on disk. Raises RuntimeError where no folder is writable."""
    dispatcher._cache = SharedCache(dispatcher.py_func)
    return dispatcher
