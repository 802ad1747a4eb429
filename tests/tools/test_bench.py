import importlib.util
import json
import statistics
from pathlib import Path

import pytest
import torch

from sart_toolkit.errors import SartError

_PATH = Path(__file__).parents[2] / "tools" / "bench.py"
_SPEC = importlib.util.spec_from_file_location("bench", _PATH)
assert _SPEC is not None and _SPEC.loader is not None
bench = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(bench)


@pytest.fixture(autouse=True)
def _threads_put_back():
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def test_the_training_benchmark_ends_with_one_json_object(capsys):
    arguments = "train --policy compact_mlp --blocks 2 --seconds 0.05 --image-size 16 --threads 1"
    assert bench.main(arguments.split()) == 0
    out, err = capsys.readouterr()
    report = json.loads(out.splitlines()[-1])
    figures = report["figures"]["compact_mlp"]
    assert figures["loop_images_per_second"] > 0 and figures["bare_images_per_second"] > 0
    low, high = figures["loop_over_bare_range"]
    assert low <= figures["loop_over_bare"] <= high
    assert report["machine"]["cores"] >= 1 and "torch" in report["versions"]
    assert "compact_mlp step" in err and len(out.splitlines()) == 1


def test_the_training_data_benchmark_compares_a_file_with_a_copy(capsys):
    arguments = "training-data --episodes 3 --blocks 2 --steps 1 --image-size 16 --threads 1"
    assert bench.main(arguments.split()) == 0
    out, err = capsys.readouterr()
    figures = json.loads(out.splitlines()[-1])["figures"]
    assert (figures["episodes"], figures["images"]) == (3, 60 + 3 * 20)
    assert figures["file_gb"] == pytest.approx(figures["images"] * 20 * 20 * 3 / 1e9)
    memory = figures["peak_memory_gb"]
    assert 0 < memory["anonymous"] < memory["total"]
    assert all(value > 0 for value in figures["images_per_second"].values())
    low, high = figures["file_over_copy_range"]
    assert low <= figures["file_over_copy"] <= high
    assert "read 4/4" in err and "block 2/2" in err


def test_the_formats_benchmark_compares_each_with_raw_images(capsys):
    assert bench.main(["formats", "--n", "3", "--image-size", "16"]) == 0
    rows = json.loads(capsys.readouterr().out.splitlines()[-1])["figures"]["trajectories"]["3"]
    assert set(rows) == {"frames", "ours", "raw", *bench.FORMATS}
    assert rows["raw"]["bytes_per_frame"] == 16 * 16 * (3 + 4)
    for name in bench.FORMATS:
        assert rows[name]["bytes_per_frame"] > 0 and rows[name]["frames_per_second"] > 0


def test_the_augmentation_benchmark_counts_what_it_keeps(capsys):
    arguments = "augment --n 3 --workers 1 2 --image-size 16 --repeats 1"
    assert bench.main(arguments.split()) == 0
    out, err = capsys.readouterr()
    figures = json.loads(out.splitlines()[-1])["figures"]["by_task"]["peg_in_hole"]
    assert figures["kept"] == 2 and figures["attempted"] >= 2
    assert (
        set(figures["kept_trajectories_per_second"]) == set(figures["once_started"]) == {"1", "2"}
    )
    # Each attempt simulates two seconds, and before them the short way to a rest.
    rows = figures["kept_trajectories_per_second"].values()
    a_process = [row["median"] / count for count, row in enumerate(rows, 1)]
    per_try = figures["simulated_over_wall_a_process"] / statistics.median(a_process)
    assert 2.0 <= per_try * figures["kept"] / figures["attempted"] < 2.3
    assert "turn 1/1" in err


def test_the_drawing_benchmark_measures_each_renderer(capsys):
    arguments = "draw --tasks lid_closing --image-size 16 --repeats 2"
    assert bench.main(arguments.split()) == 0
    out, err = capsys.readouterr()
    figures = json.loads(out.splitlines()[-1])["figures"]
    milliseconds = figures["image_ms"]["lid_closing"]
    assert {"rays", "tiny_renderer"} <= set(milliseconds) <= {"rays", "tiny_renderer", "sapien"}
    assert all(value > 0 for value in milliseconds.values())
    assert "lid_closing: rays" in err


def test_the_planning_benchmark_counts_what_is_proved(capsys):
    assert bench.main(["plan", "--tasks", "peg_in_hole", "--n", "30", "--repeats", "1"]) == 0
    out, err = capsys.readouterr()
    figures = json.loads(out.splitlines()[-1])["figures"]
    low, high = figures["proved_per_second_range"]["peg_in_hole"]
    assert 0 < figures["whole_call"]["peg_in_hole"] < high and low <= high
    assert figures["proved_per_processor_second"]["peg_in_hole"] >= 0.9 * low
    assert figures["rejections"] == {"peg_in_hole": {}} and "proved/s" in err


def test_the_storage_benchmark_compares_codecs_on_real_images(capsys):
    arguments = "storage --tasks peg_in_hole --backends pybullet --image-size 32 --episodes 1"
    assert bench.main([*arguments.split(), "--repeats", "1"]) == 0
    figures = json.loads(capsys.readouterr().out.splitlines()[-1])["figures"]
    found = figures["peg_in_hole on pybullet"]
    assert found["rgb"]["raw"]["ratio"] == found["depth"]["raw"]["ratio"] == 1.0
    assert found["rgb"]["ours"]["ratio"] > found["rgb"]["lzf"]["ratio"] > 1
    assert found["depth"]["ours"]["ratio"] > 1 and "png_16_bit" not in found["rgb"]
    assert found["depth"]["png_16_bit"]["ratio"] > found["depth"]["png"]["ratio"]
    assert all(row["write_us"] > 0 and row["read_us"] > 0 for row in found["depth"].values())
    assert found["episode"]["write_ms"] > 0 and found["episode"]["kilobytes"] > 1


def test_the_dataset_benchmark_measures_programs_of_their_own(capsys):
    assert bench.main(["dataset", "--episodes", "3", "--n", "2", "3", "--image-size", "16"]) == 0
    figures = json.loads(capsys.readouterr().out.splitlines()[-1])["figures"]
    assert figures["open"]["episodes"] == figures["episodes"] == 3
    assert 0 < figures["open"]["seconds"] < figures["info"]["seconds"]
    assert figures["open"]["peak_mb"] > 0 and figures["size_mb"] > 0
    assert {n: row["kept"] for n, row in figures["augment"].items()} == {"2": 1, "3": 2}


def test_a_measured_program_that_fails_is_reported():
    with pytest.raises(SartError, match="a measured program failed: ValueError: so"):
        bench._measured("raise ValueError('so')")


def test_the_certificate_benchmark_counts_verdicts_and_what_they_miss(capsys):
    assert bench.main(["certificate", "--segments", "20", "--samples", "60", "--seed", "3"]) == 0
    figures = json.loads(capsys.readouterr().out.splitlines()[-1])["figures"]
    assert figures["segments"] == 20 and len(figures["scenes"]) == 11
    assert figures["free"] + figures["collision"] + figures["undecided"] == 20
    assert figures["free"] > 0 and figures["collision"] > 0
    assert figures["unsound"] == figures["falsely_rejected"] == 0 and figures["surprises"] == []
    assert 0 < figures["milliseconds"]["median"] <= figures["milliseconds"]["p99"]


def test_the_certificate_benchmark_can_be_of_some_scenes_only(capsys):
    arguments = "certificate --scenes meshes --segments 4 --samples 60"
    assert bench.main(arguments.split()) == 0
    figures = json.loads(capsys.readouterr().out.splitlines()[-1])["figures"]
    assert figures["segments"] == 4 and list(figures["scenes"]) == ["meshes"]
    assert figures["unsound"] == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["certificate", "--scenes", "mesh"], "unknown scene 'mesh': did you mean 'meshes'"),
        (["augment", "--repeats", "0"], "--repeats: expected a finite number > 0"),
        (["augment", "--tasks", "peg"], "unknown task 'peg'"),
        (["annotate", "--points", "0"], "--points: expected a finite number > 0"),
        (["trian"], "unknown benchmark 'trian': did you mean 'train'"),
        (["train", "--policy", "compact"], "unknown policy 'compact': did you mean 'compact_mlp'"),
        (["train", "--blocks", "0"], "--blocks: expected a finite number > 0"),
        (["training-data", "--steps", "0"], "--steps: expected a finite number > 0"),
        (["train", "--seconds", "nan"], "--seconds: expected a finite number > 0"),
    ],
)
def test_bad_arguments_are_one_line_and_exit_code_2(capsys, arguments, message):
    assert bench.main(arguments) == 2
    out, err = capsys.readouterr()
    assert not out and message in err and len(err.splitlines()) == 1
