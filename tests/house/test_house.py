"""The rules of the house: who imports whom, what an import costs, what is public, examples that run."""

import ast
import doctest
import functools
import importlib
import inspect
import re
import sys

import pytest
from places import ROOT
from started import run_python

import jfrnn

FLOORS = (  # from the lowest: a package or module of the library imports only from floors below its own
    {"_tracing"},
    {"_geometry"},
    {"_engine"},
    {"_search"},
    {"_sums", "_triangles"},
    {"_shards", "_memory"},
    {"_jax_md", "_ase"},
    {"distributed", "ase", "jax_md", "matscipy", "vesin", ""},  # "": the public names
    {"__main__", "sph"},
)
ALLOWED = {  # first-party and third-party modules that each folder may import
    "kernels": {"warp"},
    "cases": {"numpy"},
    "jfrnn": {"jax", "numpy", "jfrnn"},
}
WHERE_NEEDED = {  # third-party modules that single files import where they are needed, not when jfrnn is imported
    "_engine/start.py": {"warp"},
    "sph/frames.py": {"matplotlib", "PIL"},
    "sph/ranges.py": {"pydantic"},
    "sph/toml_scenes.py": {"pydantic", "trimesh"},
    "sph/files.py": {"trimesh"},
    "sph/inside.py": {"scipy"},
    "sph/series.py": {"h5py", "pyvista"},
    "sph/snapshots.py": {"pyvista"},
}
PUBLIC = {"Box", "EdgeList", "MemoryPlan", "NeighborList", "NeighborOverflowError", "Status", "TriangleList"}
PUBLIC |= {"count", "memory_plan", "merge_vertices", "pair_sum", "run_chunk", "search", "search_edges", "search_triangles"}
PUBLIC |= {"hilbert_decode", "hilbert_encode", "morton_decode", "morton_encode", "pairs_of_rows", "sort_order"}


def imported_modules(path):
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield node.module


def test_one_file_reads_operations_of_xla():
    """Their interface is private to JAX. What becomes of a release that changes it: `test_joint.py`."""
    files = [*(ROOT / "jfrnn").rglob("*.py"), *(ROOT / "kernels").rglob("*.py"), *(ROOT / "experiments").rglob("*.py")]
    reads = re.compile(r"\bmlir\.(ir|dialects)\b|\bmlir, \"ir\"|jaxlib\.mlir|mlir import ir\b")
    assert {path.name for path in files if reads.search(path.read_text(encoding="utf-8"))} == {"joint.py"}


@pytest.mark.parametrize("folder", ALLOWED)
def test_imports(folder):
    files = sorted((ROOT / folder).rglob("*.py"))
    assert files
    for path in files:
        roots = {module.split(".")[0] for module in imported_modules(path)} - set(sys.stdlib_module_names)
        within = {"jfrnn"} if folder in ("kernels", "cases") else set()  # jfrnn.kernels, jfrnn.cases
        within |= WHERE_NEEDED.get(path.relative_to(ROOT / folder).as_posix(), set()) if folder == "jfrnn" else set()
        within |= {path.parent.name[1:]} & {"ase", "jax_md"}  # drop-ins, where their peers are installed
        assert roots <= ALLOWED[folder] | within, f"{path.name} imports {roots - ALLOWED[folder]}"
        if folder in ("kernels", "cases"):
            own = f"jfrnn.{folder}"
            assert all(m.startswith(own) for m in imported_modules(path) if m.split(".")[0] == "jfrnn"), path.name


def modules_below(folder, name):
    """Return the path of every module of a package by its dotted name."""
    named = {path.relative_to(ROOT / folder).with_suffix("").parts: path for path in (ROOT / folder).rglob("*.py")}
    return {".".join((name, *(part for part in parts if part != "__init__"))): path for parts, path in named.items()}


@functools.cache
def taken_from(path):
    """Return what a file imports: pairs of a dotted module and a name of it, or None."""
    taken = []
    tree = ast.parse(path.read_text())
    if path == ROOT / "jfrnn" / "__init__.py":  # its modules, which it names for who checks types alone
        tree.body = [node for node in tree.body if not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            taken += [(alias.name, None) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = [".".join(package_of(path).split(".")[: 1 - node.level or None])] if node.level else []
            module = ".".join([*above, *([node.module] if node.module else [])])
            doors = {alias.asname: f"{module}.{alias.name}" for alias in node.names if alias.asname == alias.name.removeprefix("_")}
            taken += [(module, alias.name) for alias in node.names if module != "jfrnn" or alias.asname not in doors]
            taken += names_behind(tree, doors) if module == "jfrnn" else []
    return taken


def names_behind(tree, doors):
    """Return what a file reads of doors that it imports whole, by the names that it gives them: pairs as of `taken_from`."""
    read = (node for node in ast.walk(tree) if isinstance(node, ast.Attribute))
    return [(doors[x.value.id], x.attr) for x in read if isinstance(x.value, ast.Name) and x.value.id in doors]


def package_of(path):
    """Return the dotted name of the package in which a file stands."""
    parts = path.relative_to(ROOT).parent.parts
    return ".".join(("jfrnn", *parts) if parts[0] in ("cases", "kernels") else parts)


def floor_of(room):
    return next(level for level, rooms in enumerate(FLOORS) if room in rooms)


def room_of(module):
    """Return the package of a module of the library, or the module itself where it stands beside the packages."""
    return ([*module.split("."), ""])[1]


LIBRARY = modules_below("jfrnn", "jfrnn")


def names_at_door(room):
    """Return what the door of a package lists: the names that its `__init__.py` imports."""
    return {name for _, name in taken_from(LIBRARY[f"jfrnn.{room}"])}


@pytest.mark.parametrize("module", sorted(LIBRARY))
def test_floors_and_doors(module):
    """A package takes from floors below it, and only what their doors list."""
    room = room_of(module)
    for source, name in taken_from(LIBRARY[module]):
        if source.split(".")[0] != "jfrnn" or source.startswith("jfrnn.kernels"):
            continue
        if source.startswith("jfrnn.cases"):
            assert room == "sph" and "._" not in source, f"{module} takes {source}"
            continue
        other = room_of(source)
        if room == other == "sph" and f"{source}.{name}" in LIBRARY:
            continue  # a module, taken whole
        if room == other:
            assert source not in ("jfrnn", f"jfrnn.{room}"), f"{module} goes through its own door to {name}"
            continue
        assert floor_of(other) < floor_of(room), f"{module} imports {source}, which is not on a floor below"
        assert room != "sph" or "_" not in source, f"{module} takes {source}, which is private"
        if source == "jfrnn":  # the public names have no door but this
            continue
        assert source == f"jfrnn.{other}", f"{module} reaches past the door of {other}: {source}.{name}"
        at_door = {name} if LIBRARY[source].name != "__init__.py" else names_at_door(other)
        assert name in at_door, f"{module} takes {name}, which is not at the door of {other}"


@pytest.mark.parametrize("room", sorted({room_of(module) for module in LIBRARY if module.count(".") > 1} - {"sph"}))
def test_what_a_door_lists_is_taken(room):
    """A name at a door that no other package takes stands there for nobody."""
    others = [path for module, path in LIBRARY.items() if room_of(module) != room]
    taken = {name for path in others for source, name in taken_from(path) if source == f"jfrnn.{room}"}
    assert sorted(names_at_door(room) - taken) == []


def circles(graph):
    """Return the modules that reach themselves."""

    def reached(module):
        seen, waiting = set(), [module]
        while waiting:
            new = graph[waiting.pop()] - seen
            seen |= new
            waiting += new
        return seen

    return sorted(module for module in graph if module in reached(module))


def test_circles_are_found():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": set()}) == ["b", "c"]


@pytest.mark.parametrize(
    ("folder", "name"), [("jfrnn", "jfrnn"), ("kernels", "jfrnn.kernels"), ("cases", "jfrnn.cases"), ("experiments", "experiments")]
)
def test_no_circles(folder, name):
    """No module imports itself by way of others, wherever in its text the imports stand."""
    modules = modules_below(folder, name)
    graph = {}
    for module, path in modules.items():
        taken = {f"{source}.{part}" if f"{source}.{part}" in modules else source for source, part in taken_from(path)}
        graph[module] = taken & modules.keys() - {module}
    assert circles(graph) == []


def test_experiments_take_what_is_private_in_one_file():
    private = re.compile(r"jfrnn\.(_|kernels|cases\._)")
    files = (ROOT / "experiments").rglob("*.py")
    taken = {path.name: [f"{source}.{name}" for source, name in taken_from(path)] for path in files}
    assert [file for file, names in taken.items() if any(map(private.match, names))] == ["_library.py"]


def test_nothing_imports_experiments():
    for folder in ALLOWED:
        for path in (ROOT / folder).rglob("*.py"):
            assert not any(m.split(".")[0] in ("experiments", "notebooks") for m in imported_modules(path)), path.name


def test_public_names():
    assert set(jfrnn.__all__) == PUBLIC
    assert all(getattr(jfrnn, name).__doc__ for name in PUBLIC)


def test_docstrings_fit_where_an_editor_shows_them():
    """What is longer stands in a guide, which the docstring names."""
    lengths = {name: len(inspect.getdoc(getattr(jfrnn, name)).splitlines()) for name in PUBLIC}
    assert {name: length for name, length in lengths.items() if length > 40} == {}


IMPORT = """
import sys, time
import jax
before, modules = time.process_time(), set(sys.modules)
import jfrnn
assert not jax._src.xla_bridge.backends_are_initialized(), "importing jfrnn started a device"
print(sorted(m.split(".")[0] for m in set(sys.modules) - modules))
offered = {name for name in dir(jfrnn) if name not in jfrnn.__all__ and f"jfrnn.{name}" not in sys.modules} - {"__version__"}
assert jfrnn.distributed.scatter and jfrnn.ase.neighbor_list and jfrnn.sph
print(sorted(offered), hasattr(jfrnn, "serach"))
"""


def test_import_starts_nothing():
    """It offers modules, which are imported when they are asked for."""
    imported, offered = run_python("-c", IMPORT).stdout.splitlines()
    assert set(ast.literal_eval(imported)) <= {"jfrnn", *sys.stdlib_module_names}
    assert offered == "['ase', 'distributed', 'jax_md', 'matscipy', 'sph', 'vesin'] False"


def test_examples_in_docstrings():
    """Each public function has one, and so have the class of boxes and the package."""
    offered = {"jfrnn": jfrnn} | {name: getattr(jfrnn, name) for name in sorted(PUBLIC)}
    find = doctest.DocTestFinder(recurse=False, exclude_empty=True).find
    examples = [test for name, what in offered.items() for test in find(what, name, module=False, globs={}) if test.examples]
    wanted = {"jfrnn", "Box", *(name for name, what in offered.items() if inspect.isfunction(what))}
    assert wanted - {test.name for test in examples} == set()
    assert {test.name for test in examples if doctest.DocTestRunner().run(test).failed} == set()


@pytest.mark.parametrize("table", ["_build", "batches", "catalog", "hard", "meshes", "periodic", "radii", "triangles"])
def test_examples_in_cases(table):
    result = doctest.testmod(importlib.import_module(f"jfrnn.cases.{table}"))
    assert (result.attempted > 0, result.failed) == (True, 0)


def test_readme_links_exist():
    links = re.findall(r"\]\(([^)#]+)\)", (ROOT / "README.md").read_text())
    assert len(links) > 3
    assert [link for link in links if "://" not in link and not (ROOT / link).exists()] == []


def test_each_module_has_its_tests_in_the_table():
    """`tests/README.md` names every module of the library once, and files that there are; no file of tests is missing."""
    page = (ROOT / "tests" / "README.md").read_text(encoding="utf-8")
    modules, named = [], set()
    for line in re.findall(r"^\| (`.+`) \| (`.+`) \|$", page, re.MULTILINE):
        folder = re.match(r"`(\w+/)?", line[0])[1] or ""
        modules += [name if "/" in name else folder + name for name in re.findall(r"`([\w/]+)`", line[0])]
        named |= {ROOT / "tests" / f"{file}.py" for file in re.findall(r"`([\w/]+)`", line[1])}
    package = ROOT / "jfrnn"
    there = [path.relative_to(package).with_suffix("").as_posix() for path in package.glob("_[a-z]*/*.py")]
    there += [path.stem for path in package.glob("*.py")]
    assert sorted(modules) == sorted(name for name in there if not name.endswith("__init__"))
    assert [str(path) for path in named if not path.exists()] == []
    elsewhere = {"house", "cases", "experiments", "sph", "pages", "package", "whole"}  # told by the name of the folder
    listed = {path for path in (ROOT / "tests").rglob("test_*.py") if path.parent.name not in elsewhere}
    assert sorted(map(str, listed - named)) == []
