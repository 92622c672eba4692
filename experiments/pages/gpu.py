"""Tables of what was measured on GPUs, one or several."""

from functools import partial

from experiments.pages.cpu import crystals
from experiments.pages.rows import TIMES, Row, markdown, number, one, read, whole


def _ms(row: Row | None) -> str:
    return "" if row is None else number(row.get("median_s"), 1e3)


def _over(row: Row | None, ours: Row) -> str:
    """Return milliseconds, and how many times ours they are."""
    return f"{_ms(row)} ({number(row['median_s'] / ours['median_s'], digits=2)} {TIMES})" if row and row.get("median_s") else ""


def search_known() -> str:
    """Return lists of jittered lattices by particles, beside other libraries."""
    rows = read("h200/rows.jsonl")
    lines = []
    for ours in (row for row in rows if row["kind"] == "call" and row["method"] == "jfrnn warp"):
        of_scene = [row for row in rows if (row.get("layout"), row.get("points")) == (ours["layout"], ours["points"])]
        counts = one(of_scene, kind="call", method="jfrnn warp, counts")
        density = one(of_scene, kind="sum", method="pair_sum warp", gradient=False)
        others = [one(of_scene, kind="call", method=method) for method in ("warp HashGrid", "nvalchemi 0.5.0 cell_list")]
        lines.append([whole(ours["points"]), _ms(ours), _ms(counts), _ms(density), *(_over(row, ours) for row in others)])
    heads = (">particles", ">jfrnn list", ">counts", ">density by `pair_sum`")
    return markdown((*heads, ">`wp.HashGrid` without JAX", ">nvalchemi 0.5.0 `cell_list`"), lines)


def steps() -> str:
    """Return milliseconds per step of a compiled scan."""
    rows = [row for row in read("h200/rows.jsonl") if row["kind"] == "scan"]
    ways = {
        "jfrnn warp": "list made anew",
        "jfrnn warp, skin, keeps": "list with a skin, kept",
        "jfrnn warp, skin, rebuilds": "with a skin, made anew",
    }
    lines = []
    for points in dict.fromkeys(row["points"] for row in rows):
        lines.append([whole(points), *(_ms(one(rows, points=points, method=way)) for way in ways)])
    return markdown((">particles", *(f">{title}" for title in ways.values())), lines)


def sums() -> str:
    """Return milliseconds of a density, and with its gradient, by way."""
    rows = [row for row in read("h200/rows.jsonl") if row["kind"] == "sum"]
    ways = {
        "pair_sum warp": "`pair_sum`",
        "list, sum": "our list, then a sum",
        "nvalchemi list, sum": "nvalchemi's list, then a sum",
    }
    lines = []
    for points in dict.fromkeys(row["points"] for row in rows):
        found = [one(rows, points=points, method=way, gradient=gradient) for way in ways for gradient in (False, True)]
        lines.append([whole(points), *map(_ms, found)])
    heads = [f">{title}: {what}" for title in ways.values() for what in ("density", "and gradient")]
    return markdown((">particles", *heads), lines)


def size() -> str:
    """Return milliseconds on the thesis's full lattice by number of particles."""
    rows = [row for row in read("h200_size/table.csv") if row["status"] == "ok"]
    lines = []
    for method in dict.fromkeys(row["method"] for row in rows):
        found = {row["points"]: row for row in rows if row["method"] == method}
        lines.append([method, *(number(found[n]["median_s"], 1e3) if n in found else "" for n in _points(rows))])
    return markdown(("method", *(f">{whole(n)}" for n in _points(rows))), lines)


def _points(rows: list[Row]) -> list[str]:
    return list(dict.fromkeys(row["points"] for row in rows))


def decisions() -> str:
    """Return how many decisions of hard cases were right."""
    rows = [row for row in read("h200/rows.jsonl") if row["kind"] == "exactness"]
    lines = []
    for method in dict.fromkeys(row["method"] for row in rows):
        of_method = [row for row in rows if row["method"] == method]
        kinds = ", ".join(f"{row['dtype']} {row['dim']}D" for row in of_method)
        lines.append([method, kinds, whole(sum(row["cases"] for row in of_method)), whole(sum(row["wrong"] for row in of_method))])
    return markdown(("method", "kinds", ">decisions", ">wrong"), lines)


def triangles() -> str:
    """Return milliseconds of triangles near a million points."""
    rows = [row for row in read("triangles/h200.jsonl") if row["kind"] == "triangles"]
    ways = {
        "jfrnn warp, update": "`warp`, wall stays",
        "jfrnn warp, rebuild": "wall anew",
        "jfrnn bvh, update": "`bvh`, wall stays",
        "jfrnn bvh, rebuild": "wall anew",
        "jfrnn jax, update": "`jax`, wall stays",
        "wp.Mesh, nearest, kernel alone": "Warp's tree, nearest",
    }
    lines = []
    for faces, cutoff, dtype in sorted({(row["faces"], row["cutoff"], row["dtype"]) for row in rows}):
        found = [one(rows, faces=faces, cutoff=cutoff, dtype=dtype, method=way) for way in ways]
        pairs = whole(found[0]["pairs"]) if found[0] else ""
        lines.append([whole(faces), str(cutoff), dtype, pairs, *map(_ms, found)])
    return markdown((">faces", ">cutoff [modules]", "dtype", ">pairs", *(f">{title}" for title in ways.values())), lines)


def sent() -> str:
    """Return what devices send each other for one density."""
    rows = [row for row in read("distributed/table.csv") if int(row["devices"]) > 1]
    lines = []
    for devices in dict.fromkeys(row["devices"] for row in rows):
        cells = [devices]
        for axes in (1, 3):
            row = one(rows, devices=devices, axes=axes) or {}
            halo, bytes_sent = int(row["halo"]), float(row["sent_bytes"])
            cells += [whole(halo), whole(bytes_sent / 1e3), number(bytes_sent / (20 * halo))]
        lines.append(cells)
    heads = [f">{space}: {what}" for space in ("slabs", "up to three axes") for what in ("halo", "sent [kB]", "of what is needed")]
    return markdown((">devices", *heads), lines)


def two_devices() -> str:
    """Return milliseconds on one and two GPUs of one host."""
    titles = {"list": "list", "pair_sum": "density", "sph": "step of the solver"}
    rows = [row for size in ("_16m", "", "_64m") for row in read(f"distributed/h200_x2{size}.jsonl")]
    lines = []
    for alone in (row for row in rows if row["devices"] == 1):
        both = [r for r in rows if r["devices"] == 2 and (r["work"], r["scaling"]) == (alone["work"], alone["scaling"])]
        least, most = (1.0, 1.0) if alone["scaling"] == "strong" else (1.5, 2.0)
        pair = next(r for r in both if least <= r["particles"] / alone["particles"] <= most)
        speed = [row["particles"] / row["median_s"] / row["devices"] for row in (alone, pair)]
        scaling = "the same on two" if alone["scaling"] == "strong" else "as many on each of two"
        work = [titles[alone["work"]], scaling, whole(alone["particles"]), _ms(alone), whole(pair["particles"]), _ms(pair)]
        lines.append([*work, f"{100 * speed[1] / speed[0]:.0f} %"])
    heads = ("what", "", ">particles on 1 GPU", ">ms", ">particles on 2 GPUs", ">ms", ">efficiency")
    return markdown(heads, lines)


TABLES = {
    "gpu-crystals": partial(crystals, "gpu"),
    "gpu-known": search_known,
    "gpu-steps": steps,
    "gpu-sums": sums,
    "gpu-size": size,
    "gpu-decisions": decisions,
    "gpu-triangles": triangles,
    "sent": sent,
    "two-devices": two_devices,
}
