"""Tables of the fluid solver."""

from functools import partial

from experiments.pages.rows import RESULTS, markdown, number, one, read, whole


def validation(blast: bool) -> str:
    """Return what was measured of a blast in a gas, or of the fluids with known answers."""
    rows = [row for row in read("sph/table.csv") if (row["case"] == "sedov") == blast]
    heads = ("case", "what is measured", ">measured", "target", "met", ">particles", ">steps", ">seconds", "on")
    names = ("case", "quantity", "measured", "target", "met", "particles", "steps", "seconds", "device")
    return markdown(heads, ([row[name] for name in names] for row in rows))


def inverse() -> str:
    """Return what problems solved by gradients found."""
    lines = []
    for problem, part in (("viscosity", ""), ("jet", ", along {axis}"), ("droplet", ", interval {k} of {count}")):
        rows = read(f"sph_gradients/{problem}.csv")
        for k, row in enumerate(rows, start=1):
            name, *unit = row["unknown"].partition(" [")
            sought = "".join((name, part.format(axis="xyz"[(k - 1) % 3], k=k, count=len(rows)), *unit))
            values = [number(row[name]) for name in ("guess", "found", "known", "first loss", "loss")]
            lines.append([problem, sought, *values, row["runs"], whole(row["steps"]), row["particles"]])
    heads = ("problem", "sought", ">first guess", ">found", ">known", ">loss, first", ">best", ">runs", ">steps", ">particles")
    return markdown(heads, lines)


def reverse_memory() -> str:
    """Return the scratch memory of reverse mode, by steps and segments."""
    rows = read("sph_gradients/memory.csv")
    lines = [[whole(row["steps"]), row["segments"], number(row["scratch [B]"], 1e-6)] for row in rows]
    return markdown((">steps", ">segments", ">scratch [MB]"), lines)


def ways() -> str:
    """Return steps per second by ways to find and sum pairs on 2 cores."""
    titles = {
        "pair_sum": "`pair_sum`, each of three sums searches",
        "edges of jfrnn": "edges of a list with a skin of 0.3 spacings, `jax.ops.segment_sum`",
        "jax-sph": "jax-sph's way: edges of jax-md, made anew in every step",
        "jax-sph, skin": "the same with that skin",
    }
    rows = [row for row in read("sph/speed_cpu/rows.jsonl") if row["kind"] == "step"]
    lines = []
    for way, title in titles.items():
        row = one(rows, way=way)
        assert row is not None, way
        lines.append([title, number(row["steps_per_s"]), number(row["median_s"] / rows[0]["median_s"]), number(row["bytes"], 1e-6)])
    return markdown(("way", ">steps/s", ">`pair_sum` is faster", ">MB"), lines)


def peers() -> str:
    """Return steps per second of released solvers, with what a step computes; nothing where none was measured."""
    lines = []
    folders = [name for name in ("sph_peers", "sph_peers_gpu") if (RESULTS / name).is_dir()]
    for row in [row for name in folders for row in read(f"{name}/table.csv")]:
        rate = number(1 / float(row["seconds"])) if row["seconds"] else row["reason"]
        who = f"{row['solver']} {row['version']}"
        lines.append(
            [who, row["device"], whole(row["fluid"]), whole(row["walls"]), number(row["neighbors"]), rate, row["computes"]]
        )
    heads = ("solver", "on", ">particles of the fluid", ">of walls", ">neighbors", ">steps/s", "what a step computes")
    return markdown(heads, lines)


def thin() -> str:
    """Return steps per second beside a thin wall, with and without lines of sight."""
    rows = read("sph_thin/table.csv")
    lines = [
        [row["device"], whole(row["particles"]), whole(row["parted pairs"]), _rate(row["through"]), _rate(row["sight"])]
        for row in rows
    ]
    heads = ("", ">particles", ">pairs parted", ">steps/s, water feels water through it", ">steps/s, it does not")
    return markdown(heads, lines)


def _rate(text: str) -> str:
    return number(text) or "to be measured"


def starts() -> str:
    """Return the kinetic energy that vortices keep by the start, over the exact one."""
    rows, lines = read("sph_start/table.csv"), []
    for about in dict.fromkeys((row["scheme"], row["nx"]) for row in rows):
        found = [row for row in rows if (row["scheme"], row["nx"]) == about]
        lines.append([about[0], f"{about[1]}²", *(number(row["kept"]) for row in found)])
    return markdown(("scheme", ">particles", *(f">{row['start']}" for row in rows[:3])), lines)


def kept() -> str:
    """Return steps per second of sums that search, and of those over a list with a skin."""
    lines = []
    for folder, machine in (("speed_kept", "2 cores"), ("speed_kept_h100", "H100")):
        rows = [row for row in read(f"sph/{folder}/rows.jsonl") if row["kind"] == "step"]
        for particles in dict.fromkeys(row["particles"] for row in rows):
            pair = [one(rows, particles=particles, way=way) or {} for way in ("pair_sum", "list")]
            lines.append([machine, whole(particles), *(number(row.get("steps_per_s")) for row in pair)])
    return markdown(("", ">particles with walls", ">`pair_sum`", ">over a list with a skin of 0.3 spacings"), lines)


TABLES = {
    "sph-validation": partial(validation, blast=False),
    "sph-blast": partial(validation, blast=True),
    "sph-inverse": inverse,
    "sph-memory": reverse_memory,
    "sph-ways": ways,
    "sph-kept": kept,
    "sph-peers": peers,
    "sph-starts": starts,
    "sph-thin": thin,
}
