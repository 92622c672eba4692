"""What ASE 4 reads of jfrnn when it looks for plugins: that `jfrnn.ase.neighbor_list` is a neighbor list, by the name "jfrnn".

ASE imports this module whenever it collects plugins. It stands outside of the package, and so does not import JAX; the function is
imported when it is asked for.
"""

import types

__ase_plugins__ = set()
try:
    from ase._4.plugins.neighborlist import NeighborListPlugin  # pyright: ignore[reportMissingImports]
except ImportError:  # ASE 3.29 collects plugins, but knows none that are neighbor lists
    pass
else:
    plugin = NeighborListPlugin(
        "jfrnn",
        long_name="jfrnn: pairs by exact arithmetic",
        citation="CITATION.cff of jfrnn",
        implementation="jfrnn.ase.neighbor_list",
    )
    plugin.module = types.ModuleType("jfrnn")  # of which ASE reads the name, to find the version; else it is this module
    __ase_plugins__.add(plugin)
