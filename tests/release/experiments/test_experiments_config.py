from dataclasses import replace

import numpy as np
import pytest
from places import ROOT
from started import run_python

from experiments import _config, _layouts, _rows, _sweep, _thesis, _worker, methods
from experiments._errors import UsageError
from experiments.pages import configs

CONFIGS = ROOT / "experiments" / "configs"

GOOD = """
methods = ["scipy-kdtree", "cll"]
spacing = 5e-4
repeats = 5
[[scenes]]
layouts = ["corners", "clusters7"]
fills = [0.02, 0.11]
[[scenes]]
layouts = ["full"]
"""


def load(tmp_path, text):
    path = tmp_path / "sweep.toml"
    path.write_text(text)
    return _config.load(path)


def test_specs_are_the_product_of_scenes_and_methods(tmp_path):
    config = load(tmp_path, GOOD)
    specs = list(config.specs())
    scenes = [("corners", 0.02), ("corners", 0.11), ("clusters7", 0.02), ("clusters7", 0.11), ("full", None)]
    expected = [(*scene, method) for scene in scenes for method in ("scipy-kdtree", "cll")]
    assert [(spec.layout, spec.fill, spec.method) for spec in specs] == expected
    assert len({spec.key for spec in specs}) == len(specs)


def test_a_config_is_narrowed_and_what_is_asked_for_is_checked(tmp_path):
    config = load(tmp_path, GOOD)
    asked = _config.narrow(config, methods=["warp"], layouts=["full", "corners", "diagonal"], processes=2)
    scenes = [("full", None), ("corners", 0.02), ("corners", 0.11), ("diagonal", None)]
    assert [(spec.layout, spec.fill) for spec in asked.specs() if spec.process == 0] == scenes
    assert {(spec.method, spec.process) for spec in asked.specs()} == {("warp", 0), ("warp", 1)}
    assert [spec.fill for spec in _config.narrow(config, fills=["0.3"], methods=["cll"]).specs()] == [0.3] * 3
    assert _config.narrow(config, methods=None) == config
    with pytest.raises(UsageError, match=r"\Amethods\[0\]: unknown method 'wrap'; allowed: .*\Z"):  # and not that none is left
        _config.narrow(config, methods=["wrap"])


def test_the_config_to_begin_with_says_every_key(tmp_path):
    config, text = load(tmp_path, configs.example()), configs.example()
    commented = "\n".join(line.removeprefix("# ") if " = " in line else line for line in text.splitlines())
    said = {name for kind in (_config.Config, _config.Scenes) for name in kind.model_fields} - {"scenes"}
    assert {line.split(" = ")[0] for line in commented.splitlines() if " = " in line} == said
    assert config.repeats == _config.Config.model_fields["repeats"].default


def test_a_scene_given_twice_is_measured_once(tmp_path):
    twice = load(tmp_path, GOOD + '[[scenes]]\nlayouts = ["corners"]\nfills = [0.11]\n')
    assert list(twice.specs()) == list(load(tmp_path, GOOD).specs())


def test_key_and_hash_follow_what_the_config_says(tmp_path):
    first, same = load(tmp_path, GOOD), load(tmp_path, "# another comment\n" + GOOD)
    other = load(tmp_path, GOOD.replace("repeats = 5", "repeats = 6"))
    assert first.hash == same.hash != other.hash
    keys = [[spec.key for spec in config.specs()] for config in (first, same, other)]
    assert keys[0] == keys[1]
    assert not set(keys[0]) & set(keys[2])


def test_limits_of_time_change_no_key_but_rows_that_they_cut_short_are_wanted_again(tmp_path):
    short, long = (load(tmp_path, f"most_seconds = {most}\ntimeout = {2 * most}\n" + GOOD) for most in (1.0, 9.0))
    assert [spec.key for spec in short.specs()] == [spec.key for spec in long.specs()]
    spec, later = next(short.specs()), next(long.specs())
    asked = {name: getattr(spec, name) for name in ("key", "layout", "method", *_rows.SCENE_FIELDS)}
    row = _rows.SearchRow(**asked, fill_asked=spec.fill)
    assert spec.repeats == 5
    for seconds, again in (([0.6, 0.6], False), ([0.3] * 5, False), ([0.5], True)):
        assert spec.is_cut_short(replace(row, status="ok", seconds=seconds)) is again
    assert later.is_cut_short(replace(row, status="ok", seconds=[0.6, 0.6]))
    assert not later.is_cut_short(replace(row, status="ok", seconds=[3.0] * 3))
    assert not later.is_cut_short(replace(row, status="skipped"))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("repeats = 5", "repeat = 5", r"sweep\.toml: repeat: unknown key \(value 5\); allowed: repeats, .*methods, scenes, "),
        ("fills =", "fill =", r"sweep\.toml: scenes\[0\]\.fill: unknown key \(value \[0\.02, 0\.11\]\); allowed: layouts, fills"),
        ('"full"', '"fulll"', r"scenes\[1\]\.layouts\[0\]: unknown layout 'fulll'; allowed: full, corners, .*clustersN"),
        ('"clusters7"', '"clustersN"', r"scenes\[0\]\.layouts\[1\]: unknown layout 'clustersN'; allowed: "),
        (
            '"cll"',
            '"ccl"',
            r"methods\[1\]: unknown method 'ccl'; allowed: .*brute, cll, freud, hashgrid, hashgrid-plain, jax, .*, warp",
        ),
        ("0.11]", "1.5]", r"scenes\[0\]\.fills\[1\]: got 1\.5; input should be less than or equal to 1"),
        ("0.02,", "0.0,", r"scenes\[0\]\.fills\[0\]: got 0\.0; input should be greater than 0"),
        ("repeats = 5", "repeats = 0", r"repeats: got 0; input should be greater than or equal to 1"),
        ("repeats = 5", "repeats = 5\nmax_repeats = 4", r"max_repeats: got 4; it must not be less than repeats, 5"),
        ("repeats = 5", 'dtype = "float16"', r"dtype: got 'float16'; input should be 'float32' or 'float64'"),
        ("repeats = 5", "dim = 4", r"dim: got 4; input should be 2 or 3"),
        ("spacing = 5e-4", "spacing = inf", r"spacing: got inf; input should be a finite number"),
        ('methods = ["scipy-kdtree", "cll"]', "", r"methods: missing; it must be given"),
        ('["full"]', "[]", r"scenes\[1\]\.layouts: got \[\]; the list should not be empty"),
        ('["full"]', '"full"', r"scenes\[1\]\.layouts: got 'full'; input should be a list"),
        ("repeats = 5", "seed = 2147483648", r"seed: got 2147483648; input should be less than or equal to 2147483647"),
        ("repeats = 5", "timeout = 1e9", r"sweep\.toml: timeout: got 1000000000\.0; "),
        ("repeats = 5", "processes = 0", r"sweep\.toml: processes: got 0; "),
        ("repeats = 5", "repeats = ", r"sweep\.toml: no valid TOML: "),
    ],
)
def test_a_config_error_names_file_key_and_what_is_allowed(tmp_path, old, new, message):
    assert GOOD.count(old) == 1
    with pytest.raises(UsageError, match=message) as caught:
        load(tmp_path, GOOD.replace(old, new))
    assert str(caught.value).startswith(str(tmp_path / "sweep.toml"))
    assert len(str(caught.value).splitlines()) == 1


def test_thesis_config_holds_every_scene_of_table_6_1():
    specs = list(_config.load(CONFIGS / "thesis.toml").specs())
    assert {(spec.layout, round(100 * spec.fill)) for spec in specs} == {key[:2] for key in _thesis.table()}
    still = {name for name in methods.names() if not name.endswith(("-naive", "-update", "-rebuild", "-dynamic"))}
    assert {spec.method for spec in specs} == still
    assert len(specs) == 11 * len(still) * 5
    assert all(spec.repeats >= 20 and spec.dtype == "float32" for spec in specs)


@pytest.mark.parametrize("path", sorted([*CONFIGS.glob("sweep_*.toml"), *CONFIGS.glob("thesis*.toml")]), ids=lambda path: path.stem)
def test_every_scene_of_a_config_can_be_made(path):
    specs = {spec.scene_key: spec for spec in _config.load(path).specs()}
    for spec in specs.values():
        if spec.spacing >= 1e-4:  # a domain of a million points takes as long as all others together
            assert len(_worker.make_scene(spec).positions) > 0, spec


def test_rounds_hold_the_same_rows_in_other_orders(tmp_path):
    specs = list(load(tmp_path, GOOD.replace("repeats = 5", "repeats = 5\nprocesses = 3")).specs())
    rounds = [[(spec.scene_key, spec.method) for spec in specs if spec.process == process] for process in range(3)]
    assert [spec.process for spec in specs] == sorted(spec.process for spec in specs)
    assert sorted(map(str, rounds[0])) == sorted(map(str, rounds[1])) == sorted(map(str, rounds[2]))
    assert rounds[0] != rounds[1] != rounds[2]
    assert rounds[0] == [(spec.scene_key, spec.method) for spec in load(tmp_path, GOOD).specs()]
    assert len({spec.key for spec in specs}) == len(specs)


def test_whatever_is_given_several_times_is_multiplied(tmp_path):
    axes = 'angles = [0, 45]\ncutoff_ratios = [2, 3]\norders = ["layout", "shuffled"]\nseeds = [1]\n'
    specs = list(load(tmp_path, f'methods = ["cll"]\n[[scenes]]\nlayouts = ["turned4"]\n{axes}').specs())
    found = {(spec.angle, spec.cutoff_ratio, spec.order) for spec in specs}
    assert found == {(a, r, o) for a in (0, 45) for r in (2, 3) for o in ("layout", "shuffled")}
    assert {spec.seed for spec in specs} == {1}
    first, second = (_worker.make_scene(spec) for spec in specs[:2])
    assert not np.array_equal(first.positions, second.positions)
    assert np.array_equal(np.sort(first.positions, axis=0), np.sort(second.positions, axis=0))


def test_orders_keep_the_particles():
    scenes = [_layouts.order_scene(_layouts.make("jitter", spacing=5e-4), order, 3) for order in ("layout", "sorted", "shuffled")]
    known = [np.unique(scene.positions, axis=0) for scene in scenes]
    assert all(np.array_equal(known[0], other) for other in known[1:])
    for scene, is_sorted in zip(scenes, (False, True, False), strict=True):
        cells = np.floor(scene.positions / scene.cutoff).astype(int)
        assert (np.diff(cells @ [10_000, 100, 1]) >= 0).all() == is_sorted
    again = _layouts.order_scene(scenes[0], "shuffled", 3)
    assert np.array_equal(again.positions, scenes[2].positions)


def test_smoke_config_has_every_method():
    assert set(_config.load(CONFIGS / "smoke.toml").methods) == set(methods.names())


def test_what_needs_nothing_heavy_imports_nothing_heavy(tmp_path):
    """The help of commands, and then a worker that searches without JAX, in one process."""
    (spec,) = load(tmp_path, 'methods = ["scipy-kdtree"]\nspacing = 1e-3\nrepeats = 1\n[[scenes]]\nlayouts = ["corners"]\n').specs()
    task = _sweep._task("measure", spec, tmp_path)
    heavy = {"jax", "scipy", "warp", "matplotlib", "pyvista", "pandas", "numpy", "pydantic"}
    code = f"import sys; from experiments import _cli; print(sorted({heavy} & set(sys.modules)))\n"
    code += f"from experiments import _worker; print(_worker._answer({task})['status'])\n"
    code += "print(sorted({'jax', 'jfrnn', 'pandas', 'matplotlib'} & set(sys.modules)))"
    assert run_python("-c", code, timeout=60).stdout.splitlines() == ["[]", "ok", "[]"]
