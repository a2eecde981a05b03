"""The control adapter's tests need its extra."""

from importlib.util import find_spec

_EXTRA = ("h5py", "matplotlib", "minari", "mujoco")
collect_ignore_glob = [] if all(map(find_spec, _EXTRA)) else ["*"]
