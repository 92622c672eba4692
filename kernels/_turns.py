"""The lock of all that starts, compiles and lays plans, one thread at a time."""

import os
import threading

one_at_a_time = threading.RLock()
if hasattr(os, "register_at_fork"):  # a lock that another thread holds while a process forks would stay taken in the new one
    os.register_at_fork(before=one_at_a_time.acquire, after_in_parent=one_at_a_time.release, after_in_child=one_at_a_time.release)
