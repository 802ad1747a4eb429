"""Each verb that writes refuses an output on which another is at work, also with --overwrite."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from sart_toolkit.cli import main
from sart_toolkit.data.dataset import Dataset
from sart_toolkit.data.formats import get_format
from sart_toolkit.data.formats.format import about_dataset
from sart_toolkit.data.formats.transfer import export_dataset
from sart_toolkit.data.records import Annotation, Demonstration
from sart_toolkit.data.storage import OutputLock, save_annotation, save_demonstration
from sart_toolkit.learn.skill import save_skill
from sart_toolkit.learn.training import TrainConfig, train

CELLS = "--tasks peg_in_hole --backends pybullet --out OUT"
# OUT is what is locked; most are given it.
VERBS = {
    "record": "record peg_in_hole --out OUT --overwrite",
    "suggest": "suggest demo.h5 --out OUT --overwrite",
    "annotate": "annotate demo.h5 --suggest-all --no-window --out OUT --overwrite",
    "augment": "augment demo.h5 annotation.json --n 4 --out OUT --overwrite",
    "augment --dry-run": "augment demo.h5 annotation.json --dry-run --out OUT --overwrite",
    "merge": "merge dataset --out OUT --overwrite",
    "split": "split dataset --n 3 --out OUT --overwrite",
    "split --parts": "split dataset --parts a=1 --out OUT --overwrite",
    "export": "export dataset --format lerobot --out OUT --overwrite",
    "export, a file": "export dataset --format robomimic --out OUT.hdf5 --overwrite",
    "import": "import recording.rmb --out OUT --overwrite",
    "train": "train dataset --epochs 1 --out OUT --overwrite",
    "evaluate": "evaluate skill --episodes 1 --out OUT --overwrite",
    "report": "report run --out OUT --overwrite",
    "run": "run peg_in_hole --out OUT --overwrite",
    "play": "play demo.h5 --out OUT.mp4 --overwrite",
    "benchmark operator": f"benchmark operator {CELLS} --overwrite",
    "benchmark replay": "benchmark replay --tasks peg_in_hole --out OUT --overwrite",
    "benchmark segments": f"benchmark segments {CELLS} --overwrite",
    "benchmark radii": f"benchmark radii {CELLS} --overwrite",
    "benchmark cloud": f"benchmark cloud {CELLS} --overwrite",
    "benchmark skill": f"benchmark skill {CELLS}",
}
LOCKED = {
    "play": "OUT.mp4",
    "export, a file": "OUT.hdf5",
    "split --parts": "OUT/a",
    "benchmark skill": "OUT/benchmark.json",
}


@pytest.fixture(scope="module")
def inputs(
    peg_demonstration: Demonstration,
    peg_annotation: Annotation,
    peg_dataset: Dataset,
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """A directory with what the verbs read."""
    path = tmp_path_factory.mktemp("inputs")
    save_demonstration(path / "demo.h5", peg_demonstration)
    save_annotation(path / "annotation.json", peg_annotation)
    shutil.copytree(peg_dataset.path, path / "dataset")
    about = about_dataset(peg_demonstration)
    export_dataset(peg_demonstration, get_format("rmb"), path / "recordings", about)
    shutil.move(path / "recordings" / "peg_in_hole_0000.rmb", path / "recording.rmb")
    config = TrainConfig.for_policy(
        "compact_mlp", epochs=1, image_size=32, batch_size=16, hidden=16, threads=1, device="cpu"
    )
    save_skill(path / "skill", train(peg_dataset, config, path / "skill"), peg_dataset)
    (path / "run").mkdir()
    return path


@pytest.fixture
def there(inputs: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(inputs)
    return inputs


def refusal(capsys: pytest.CaptureFixture[str], command: str) -> str:
    capsys.readouterr()
    with pytest.raises(SystemExit) as exit_:
        main(command.split())
    assert exit_.value.code == 2
    return capsys.readouterr().err


@pytest.mark.parametrize("verb", VERBS)
def test_an_output_at_which_another_works_is_refused(
    verb: str, there: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    locked = Path(LOCKED.get(verb, "OUT").replace("OUT", str(out)))
    with OutputLock(locked):
        before = sorted(tmp_path.rglob("*"))
        said = refusal(capsys, VERBS[verb].replace("OUT", str(out)))
        assert f"{locked}: another process is using it; end that one first" in said
        assert sorted(tmp_path.rglob("*")) == before


def test_a_run_is_not_overwritten_while_a_part_of_it_is_written(
    there: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The older lock was on a file in the dataset, which went with the rest of the run."""
    out = tmp_path / "run"
    out.mkdir()
    (out / "run.json").write_text("{}")
    shutil.copytree(there / "dataset", out / "dataset")
    with OutputLock(out / "dataset"):
        said = refusal(capsys, f"run peg_in_hole --out {out} --overwrite")
    assert "dataset: another process is using it" in said
    assert (out / "dataset" / "dataset.json").exists() and (out / "run.json").exists()


@pytest.mark.parametrize(
    "command",
    ["suggest demo.h5 --out LINK", "augment demo.h5 annotation.json --n 3 --out LINK"],
)
@pytest.mark.parametrize("there_before", [True, False])
def test_what_a_link_points_to_is_written(
    command: str, there_before: bool, there: Path, tmp_path: Path
) -> None:
    (tmp_path / "link").symlink_to("disk/target")
    if there_before and command.startswith("augment"):
        (tmp_path / "disk" / "target").mkdir(parents=True)
    main(command.replace("LINK", str(tmp_path / "link")).split())
    if there_before:
        main([*command.replace("LINK", str(tmp_path / "link")).split(), "--overwrite"])
    assert (tmp_path / "link").is_symlink()
    assert [p.name for p in (tmp_path / "disk").iterdir()] == ["target"]
