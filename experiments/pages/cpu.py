"""Tables of what was measured on CPUs."""

from functools import partial
from statistics import median

from experiments.pages.rows import TIMES, Row, machine, markdown, number, one, read, whole
from jfrnn.cases.catalog import CATALOG

OURS = {
    "warp": "jfrnn, list",
    "warp-counts": "jfrnn, counts",
    "pair-sum": "jfrnn, density by `pair_sum`",
    "jax": "jfrnn, engine `jax`, list",
    "hashgrid": "jfrnn, engine `hashgrid`, list",
}
_KNOWN = {  # methods that people know, and how they are called
    "vesin": "vesin",
    "matscipy": "matscipy",
    "matscipy-neighbours": "matscipy-neighbours",
    "nvalchemi": "nvalchemi-toolkit-ops",
    "scipy-kdtree": "SciPy's cKDTree",
    "freud": "freud",
    "nanoflann-cpp": "nanoflann, C++",
    "ann-kd": "ANN, kd-tree",
    "cll": "first/next cell lists (the thesis)",
    "hashgrid-plain": "Warp's HashGrid, plain",
}


def name_of(method: str) -> str:
    """Return what a method is called in pages."""
    return (OURS | _KNOWN).get(method, method)


def _wrong(row: Row, kind: str) -> str:
    return ("~" if row["compared"] == "counts" else "") + whole(row[kind])


def search_known() -> str:
    """Return the full lattice of the thesis, by the methods that people know."""
    rows = read("thesis_cpu/table.csv")
    found = [row for name in [*OURS, *_KNOWN] if (row := one(rows, scene="full 100 %", method=name, status="ok"))]
    lines = []
    for row in sorted(found, key=lambda row: float(row["median_s"])):
        wrong = [_wrong(row, kind) for kind in ("missing", "extra")]
        lines.append([name_of(row["method"]), number(row["median_s"], 1e3), number(row["search_mb"]), *wrong])
    return markdown(("method", ">ms", ">MB", ">missing", ">extra"), lines)


def search_scenes() -> str:
    """Return seconds of all methods by scene."""
    rows = read("thesis_cpu/table.csv")
    layouts = (("corners", "0.02"), ("clusters4", "0.11"), ("clusters20", "0.51"), ("full", "1.0"))
    titles = ("corners", "4 clusters", "20 clusters", "full")
    scenes = {row["scene"]: titles[layouts.index(key)] for row in rows if (key := (row["layout"], row["fill_asked"])) in layouts}
    full = {row["method"]: float(row["median_s"] or "inf") for row in rows if row["scene"] == "full 100 %"}
    methods = sorted(dict.fromkeys(row["method"] for row in rows), key=lambda method: full.get(method, float("inf")))
    points = {scene: whole(next(row["points"] for row in rows if row["scene"] == scene)) for scene in scenes}
    lines = []
    for method in methods:
        of_scene = [one(rows, scene=scene, method=method) for scene in scenes]
        cells = [number(row["median_s"], 1e3) if row and row["status"] == "ok" else "" for row in of_scene]
        if not any(cells):
            continue
        last = of_scene[-1]
        known = last if last and last["status"] == "ok" else None
        lines.append([name_of(method), *cells, *([_wrong(known, "missing"), _wrong(known, "extra")] if known else ["", ""])])
    heads = [f">{title}, {points[scene]}" for scene, title in scenes.items()]
    return markdown(("method", *heads, ">missing, full", ">extra, full"), lines)


def latency() -> str:
    """Return microseconds of calls and, behind a stroke, of steps for few particles."""
    ours = {"list": "list", "counts": "counts", "density": "density", "density, gradient": "its gradient"}
    heads = ["", ">n", ">`x + 1`", *(f">{title}" for title in ours.values()), ">jax-md list", ">nvalchemi list"]
    lines = []
    for rows in (read("latency/cpu.csv"), read("latency/gpu.csv")):
        for n in (64, 256, 1000, 4096, 32768):
            of_n = [row for row in rows if row["n"] == str(n) and row["status"] == "ok"]
            if not of_n:
                continue
            floor, mine = one(of_n, what="x + 1"), [one(of_n, who="jfrnn", what=what) for what in ours]
            peers = [[row for row in of_n if row["who"].startswith(who)] for who in ("jax-md", "nvalchemi")]
            fastest = [min((float(row["waited_us"]) for row in peer), default=None) for peer in peers]
            line = [machine(rows), whole(n), _us(floor, "waited_us")]
            line += [f"{_us(row, 'waited_us')} / {_us(row, 'step_us')}" if row else "" for row in mine]
            lines.append([*line, *("" if us is None else whole(round(us)) for us in fastest)])
    return markdown(heads, lines)


def _us(row: Row | None, column: str) -> str:
    return "" if row is None else whole(round(float(row[column])))


def sums() -> str:
    """Return a density, and its gradient, in many ways."""
    rows = [row for row in read("sums/table.csv") if row["layout"] == "full" and row["points"] == "250000"]
    ways = {
        ("pair_sum warp", False): "`pair_sum`, `warp`",
        ("pair_sum warp", True): "the same, compensated",
        ("list, sum", False): "padded list, then a sum in plain JAX",
        ("list, pair_sum", False): "list, `pair_sum(neighbors=)`, before a kernel read the list",
        ("flat list, pair_sum", False): "flat list, `pair_sum(neighbors=)`, an array program",
        ("pair_sum jax", False): "`pair_sum`, `jax`",
        ("nvalchemi list, sum", False): "nvalchemi's list, then the sum",
        ("scipy pairs alone", False): "SciPy's pairs alone, no sum",
    }
    lines = []
    for (way, compensated), title in ways.items():
        of_way = [one(rows, way=way, compensated=compensated, sums=what) for what in ("density", "density, gradient")]
        cells = [(number(r["seconds"], 1e3), number(r["B per particle"])) if r else ("", "") for r in of_way]
        if any(of_way):
            lines.append([title, *(cell for pair in cells for cell in pair)])
    return markdown(("way", ">density [ms]", ">B per particle", ">and gradient [ms]", ">B per particle"), lines)


def ties() -> str:
    """Return what ties cost, as multiples of the time for sites moved at random."""
    lines = []
    for scene in ("spacing 1", "spacing 1/64", "spacing 1e-4", "spacing 1, one particle off"):
        cells = []
        for file in ("cpu", "gpu"):
            for dtype in ("float32", "float64"):
                row = one(read(f"ties/cube/{file}_warp.csv"), sites=scene, dtype=dtype)
                cells.append("" if row is None else ", ".join(row[f"{what}_ratio"] for what in ("count", "list", "density")))
        lines.append([scene, *cells])
    return markdown(("sites of a cube", "2 cores, float32: counts, list, density", "float64", "H100, float32", "float64"), lines)


def empty_space() -> str:
    """Return seconds of a search while clusters are drawn apart."""
    rows = [row for row in read("sweep_domain/table.csv") if row["status"] == "ok"]
    growths = list(dict.fromkeys(row["growth"] for row in rows))
    lines = []
    for method in dict.fromkeys(row["method"] for row in rows):
        cells = [one(rows, method=method, growth=growth) for growth in growths]
        lines.append([name_of(method), *(number(row["median_s"], 1e3) if row else "" for row in cells)])
    return markdown(("method", *(f">{whole(growth)} {TIMES}" for growth in growths)), lines)


def triangles() -> str:
    """Return milliseconds of triangles near points, by engine."""
    rows = read("triangles/cpu_warp.csv")
    ways = {
        "jfrnn bvh update": "`bvh`, wall stays",
        "jfrnn bvh rebuild": "wall anew",
        "jfrnn warp update": "`warp`, wall stays",
        "jfrnn warp rebuild": "wall anew",
        "libigl": "libigl, nearest",
        "wp.Mesh nearest": "Warp's tree, nearest",
    }
    lines = []
    for faces, cutoff in dict.fromkeys((row["faces"], row["cutoff"]) for row in rows):
        found = [one(rows, faces=faces, cutoff=cutoff, method=way) for way in ways]
        pairs = found[0]["pairs"] if found[0] else ""
        lines.append([whole(faces), cutoff, whole(pairs), *(number(row["median_s"], 1e3) if row else "" for row in found)])
    return markdown((">faces", ">cutoff [modules]", ">pairs", *(f">{title}" for title in ways.values())), lines)


def answers(rows: list[Row] | None = None) -> str:
    """Return what each library answers on the hard cases: those of the page, or those of other rows of `bench peers`."""
    rows = read("peers/answers.csv") if rows is None else rows
    versions = {row["peer"]: row["version"] for row in rows}
    lines = []
    for case in (row.title for row in CATALOG if row.cases):
        of_case = [[row for row in rows if (row["row"], row["peer"]) == (case, peer)] for peer in versions]
        lines.append([case, *map(_summarize, of_case)])
    return markdown(("case", *(f"{peer} {version}" for peer, version in versions.items())), lines)


def _summarize(rows: list[Row]) -> str:
    """Say in a word or two what a peer answered on all cases of a row."""
    if all(row["answer"] == "right" for row in rows):
        return "right"
    parts = []
    for row in rows:
        counts = [f"{row[kind]} {kind}" for kind in ("missing", "extra") if row[kind] not in ("", "0")]
        said = {"wrong": ", ".join(counts), "error": f"error: {row['reason'].rstrip('.')[:60]}"}
        parts.append(said.get(row["answer"], row["answer"]))
    return "; ".join(part for part in dict.fromkeys(parts) if part != "right")


def structures() -> str:
    """Return seconds of many small structures, one after another, and microseconds of a call."""
    rows = read("structures/cpu.csv")
    lines = []
    for who, cache, title in (("jfrnn", "warm", "`jfrnn.ase`"), ("jfrnn", "cold", "the same, kernels compiled first")):
        lines.append((who, title, one(rows, who=who, cache=cache)))
    others = {"ase": "ASE", "matscipy": "matscipy", "matscipy-neighbours": "matscipy-neighbours", "vesin": "vesin"}
    lines += [(who, title, next(row for row in rows if row["who"] == who and row["structures"])) for who, title in others.items()]
    table = []
    for who, title, row in lines:
        call = None if row is None or row["cache"] == "cold" else next(r for r in rows if r["who"] == who and r["atoms"])
        assert row is not None, title
        cells = [title, number(row["total_s"]), number(row["first_s"]), number(call and call["median_us"]), whole(row["pairs"])]
        table.append(cells)
    many = next(whole(row["structures"]) for row in rows if row["structures"])
    heads = (
        f">{many} structures [s]",
        ">of it the first call, import included [s]",
        ">a warm call, 32 atoms [µs]",
        ">pairs of all",
    )
    return markdown(("library", *heads), table)


def crystal_ties() -> str:
    """Return how many pairs each library misses or has too many in crystals full of distances at the cutoff."""
    heads = ("library", ">crystals", ">pairs", ">distances at the cutoff", ">misses", ">has too many")
    rows = read("structures/ties.csv")
    return markdown(heads, [[f"{row['library']} {row['version']}".strip(), *map(whole, [*row.values()][2:])] for row in rows])


def crystals(file: str) -> str:
    """Return milliseconds of batches of crystals, each in a skewed cell of its own."""
    rows = [row for row in read(f"crystals/{file}.csv") if row["status"] == "ok"]
    ways = {("jfrnn", "list"): "jfrnn list", ("jfrnn", "counts"): "counts", ("nvalchemi", "list"): "nvalchemi list"}
    ways |= {("vesin", "list"): "vesin, one by one"} if any(row["who"] == "vesin" for row in rows) else {}
    lines = []
    for systems, atoms in dict.fromkeys((row["systems"], row["atoms"]) for row in rows):
        found = [one(rows, systems=systems, atoms=atoms, who=who, what=what) for who, what in ways]
        cells = [f"{number(row['waited_ms'])}{_particles(row['wrong'])}" if row else "" for row in found]
        lines.append([whole(systems), whole(atoms), whole(found[0]["pairs"]) if found[0] else "", *cells])
    heads = (">crystals", ">atoms each", ">pairs", *(f">{title}" for title in ways.values()))
    return markdown(heads, lines)


def _particles(wrong: str) -> str:
    return "" if wrong in ("", "0") else f" ({whole(wrong)} wrong)"


def first_call() -> str:
    """Return seconds of a fresh process from `import jfrnn` to its first result, with kernels and without."""
    rows = [row for row in read("latency/start_cpu.csv") if row["status"] == "ok" and row["who"] == "after"]
    lines = []
    for what, title in (("search", "a list"), ("gradient", "the gradient of a density")):
        cells = []
        for cache in ("cold", "warm"):
            cells.append(number(median(float(row["wait_s"]) for row in rows if (row["what"], row["cache"]) == (what, cache))))
        lines.append([title, *cells])
    return markdown(("", ">kernels compiled first [s]", ">kernels in the cache [s]"), lines)


TABLES = {
    "structures": structures,
    "crystal-ties": crystal_ties,
    "crystals": partial(crystals, "cpu"),
    "first-call": first_call,
    "cpu-known": search_known,
    "cpu-scenes": search_scenes,
    "latency": latency,
    "cpu-sums": sums,
    "ties": ties,
    "empty-space": empty_space,
    "cpu-triangles": triangles,
    "answers": answers,
}
