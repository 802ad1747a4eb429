from __future__ import annotations

import base64
import dataclasses
import hashlib
import io
import json
import re
import shutil
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as PillowImage

from sart_toolkit import get_robot, get_task
from sart_toolkit.data.dataset import Dataset
from sart_toolkit.data.records import Demonstration
from sart_toolkit.data.storage import load_demonstration, save_demonstration
from sart_toolkit.data.writer import write_dataset
from sart_toolkit.errors import BrokenFile, CannotWrite, Mismatch, MissingFile, UnknownName
from sart_toolkit.report import page as report
from sart_toolkit.report.figures import film_strip, scene_image
from sart_toolkit.report.page import at_least_mm, at_most_mm, duration, percent, write_report

EditJson = Callable[[Path, dict[str, Any]], None]
VOID = {"img", "source", "meta", "input", "br", "wbr"}
HOSTILE = "<script>alert(1)</script>\"' onload='x' https://evil.example/"


class Page(HTMLParser):
    """A page's elements with their attributes, its text, its scripts, and what isn't closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.words: list[str] = []
        self.scripts: list[str] = []
        self.open: list[str] = []
        self.source = text
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {key: value or "" for key, value in attrs}))
        if tag not in VOID:
            self.open.append(tag)
        if tag in ("td", "br"):
            self.words.append(" ")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open[-1:] == ["script"]:
            self.scripts.append(data)
        elif self.open[-1:] != ["style"]:
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join("".join(self.words).split())

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.elements if name == tag]


def written(run_dir: Path) -> Page:
    out = run_dir / "report.html"
    write_report(run_dir, out)
    page = Page(out.read_text())
    assert page.open == []
    return page


@pytest.fixture(autouse=True)
def _quick_drawings(monkeypatch: pytest.MonkeyPatch, small_png: bytes) -> None:
    """Drawings are tested beside; only `page`, made before this, shows real ones."""
    for name in ("scene_image", "training_curve", "placement_image"):
        monkeypatch.setattr(report, name, lambda *_: small_png)


@pytest.fixture(scope="module")
def small_png(demonstration: Demonstration) -> bytes:
    return film_strip(demonstration, n=2, size=32)


@pytest.fixture(scope="module")
def page(_finished_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Page:
    out = tmp_path_factory.mktemp("report") / "report.html"
    write_report(_finished_run, out)
    return Page(out.read_text())


def test_page_asks_nothing_of_any_network(page: Page) -> None:
    for _, attributes in page.elements:
        for name in ("src", "href", "srcset", "poster", "action", "data"):
            assert attributes.get(name, "data:").startswith(("data:", "#"))
    assert not page.all("link") and not page.all("iframe")
    assert "url(" not in page.source and "@import" not in page.source
    assert re.search(r"https?://", page.source) is None
    policies = [m["content"] for m in page.all("meta") if "http-equiv" in m]
    assert len(policies) == 1 and policies[0].startswith("default-src 'none'")
    assert "connect-src" not in policies[0]


def test_only_the_page_s_own_scripts_may_run(page: Page) -> None:
    (policy,) = [m["content"] for m in page.all("meta") if "http-equiv" in m]
    assert [script.get("type") for script in page.all("script")] == ["application/json", None, None]
    allowed = re.findall(r"'sha256-([^']+)'", policy.partition("script-src")[2])
    own = [hashlib.sha256(script.encode()).digest() for script in page.scripts[1:]]
    assert [base64.b64decode(digest) for digest in allowed] == own


def test_page_carries_its_images_and_videos(page: Page, _finished_run: Path) -> None:
    videos = [v["src"] for v in page.all("video")]
    expected = [
        (_finished_run / "videos" / f"{name}_000.mp4").read_bytes()
        for name in ("success", "failure")
    ]
    assert [base64.b64decode(v.removeprefix("data:video/mp4;base64,")) for v in videos] == expected
    posters = [
        np.asarray(PillowImage.open(io.BytesIO(base64.b64decode(v["poster"].partition(",")[2]))))
        for v in page.all("video")
    ]
    # Each shows its outcome's strip, and not the other's.
    assert len(posters) == 2 and not np.array_equal(*posters)
    images = page.all("img")
    assert len(images) == 4
    for image in images:
        assert image["src"].startswith("data:image/png;base64,iVBOR")
        assert len(image["alt"]) > 20
        assert int(image["width"]) > 300 and int(image["height"]) > 100
    darker = [source["media"] for source in page.all("source")]
    assert darker == ["screen and (prefers-color-scheme: dark)"] * 2


def test_page_is_readable_on_any_screen_and_by_screen_readers(page: Page) -> None:
    assert page.all("html") == [{"lang": "en"}]
    assert any(m.get("name") == "viewport" for m in page.all("meta"))
    assert len(page.all("h1")) == 1
    assert all("aria-label" in v and "controls" in v for v in page.all("video"))
    roles = [a for _, a in page.elements if "role" in a]
    assert roles and all(a["aria-label"] for a in roles)
    assert all(th.get("scope") == "col" for th in page.all("th"))


def test_headline_and_film_come_first_and_the_contents_lead_to_each_section(page: Page) -> None:
    assert page.text.index("18 / 20") < page.text.index("The skill at work")
    tags = [tag for tag, _ in page.elements]
    assert tags.index("video") < tags.index("img")
    sections = [a["id"] for a in page.all("section")]
    assert [a["href"] for a in page.all("a")] == [f"#{name}" for name in sections]
    assert len(set(sections)) == len(sections) == 11


def test_films_of_success_and_failure_stand_side_by_side(
    run_dir: Path, edit_json: EditJson
) -> None:
    rows = [
        {"path": f"videos/{outcome}_000.mp4", "episode": episode, "outcome": outcome}
        for episode, outcome in enumerate(("success", "success", "failure", "failure"))
    ]
    edit_json(run_dir / "evaluation.json", {"videos": rows})
    labels = [video["aria-label"] for video in written(run_dir).all("video")]
    assert [label.rpartition(" ")[2] for label in labels] == ["success", "failure"] * 2


def test_its_commands_can_be_typed(run_dir: Path) -> None:
    text = written(run_dir).text
    assert f"sart report {run_dir}" in text
    played = [Path(path) for path in re.findall(r"sart play (\S+\.h5)", text)]
    episodes = set((run_dir / "dataset" / "episodes").rglob("*.h5"))
    assert set(played) == {run_dir / "demo.h5", *episodes}


def test_the_commit_that_made_a_run_is_named(run_dir: Path, edit_json: EditJson) -> None:
    assert "commit not recorded" in written(run_dir).text
    edit_json(run_dir / "run.json", {"commit": 40 * "a"})
    assert f"commit {40 * 'a'} ." in written(run_dir).text.replace(".", " .")
    edit_json(run_dir / "run.json", {"commit": 40 * "a" + "+"})
    assert "with changes that were not committed" in written(run_dir).text


def test_page_tells_the_figures(page: Page) -> None:
    for words in (
        "peg_in_hole",
        "18 / 20",
        "90 %, Wilson 95 % interval 64 % to 95 %",
        "41 steps over 4.0 s",
        "steered by scripted operator",
        "no demonstrating: a script steered",
        "no annotating: radii suggested by the toolkit",
        "4 min 50 s",
        "12 of 15 attempted trajectories were kept (80 %)",
        "path too close peg / block",
        "Clearance along the commanded path of a segment, before the robot moved proved "
        "at least 1.25 mm 12 of 12 trajectories",
        "Clearance along the path through the joint positions measured on the way proved "
        "at least 0.62 mm 12 of 12 trajectories",
        "from where its commanded path has it measured at most 0.41 mm 12 of 12 trajectories",
        "80.0 mm",
        "gripper - table",
        "compact_mlp was trained for 12 epochs",
        "18 of 20 rollouts succeeded.",
        "time limit: peg beside the hole",
        "Table of 20 episodes",
        "3 min 32 s",
        "sart run peg_in_hole --out run",
        "2.13.0",
    ):
        assert words in page.text


def test_claims_of_clearance_are_the_episodes_own(run_dir: Path, dataset: Dataset) -> None:
    proof = {"commanded": {"clearance": 0.004}, "measured": {"clearance": 0.003}, "deviation": 2e-4}
    episodes = [
        dataclasses.replace(
            episode,
            provenance=dataclasses.replace(
                episode.provenance, certificate=proof if k < 5 else None
            ),
        )
        for k, episode in enumerate(dataset)
    ]
    shutil.rmtree(run_dir / "dataset")
    (source,) = dataset.sources
    whole = [(source.demonstration, source.annotation)]
    write_dataset(run_dir / "dataset", whole, episodes, dataset.info)
    text = written(run_dir).text
    assert text.count("5 of 12 trajectories") == 3
    assert "at least 4.00 mm" in text and "at least 3.00 mm" in text
    assert "at most 0.20 mm" in text


def test_a_bound_names_the_pair_that_it_is_of_and_what_the_backend_declares(
    run_dir: Path, dataset: Dataset
) -> None:
    def proof(k: int) -> dict[str, Any]:
        return {
            "commanded": {"clearance": 0.004 + 0.001 * k, "pair": [f"peg {k}", "block"]},
            "measured": {"clearance": 0.009 - 0.0001 * k, "pair": [f"finger {k}", "table"]},
            "deviation": 2e-4,
            "tracking_error": 4e-4,
        }

    episodes = [
        dataclasses.replace(
            episode, provenance=dataclasses.replace(episode.provenance, certificate=proof(k))
        )
        for k, episode in enumerate(dataset)
    ]
    shutil.rmtree(run_dir / "dataset")
    (source,) = dataset.sources
    whole = [(source.demonstration, source.annotation)]
    write_dataset(run_dir / "dataset", whole, episodes, dataset.info)
    text = written(run_dir).text
    assert "at least 4.00 mm peg 0 / block" in text
    assert "at least 7.90 mm finger 11 / table" in text
    assert "at most 0.20 mm the backend declares at most 0.40 mm" in text


def test_every_rollout_is_in_the_table(page: Page) -> None:
    outcomes = [a["class"] for tag, a in page.elements if tag == "span" and "badge" in str(a)]
    # Two of the badges belong to the videos.
    assert outcomes.count("badge success") == 19
    assert outcomes.count("badge failure") == 3


def test_same_run_gives_the_same_page(run_dir: Path) -> None:
    assert written(run_dir).source == written(run_dir).source


@pytest.mark.parametrize(
    ("missing", "note"),
    [
        ("demo.h5", "No demo.h5 in this run: nothing was recorded yet."),
        ("annotation.json", "No annotation.json in this run"),
        ("dataset", "No finished dataset in this run"),
        ("dataset/dataset.json", "No finished dataset in this run"),
        ("skill", "No skill/training.json in this run"),
        ("evaluation.json", "the skill was not evaluated yet"),
        ("run.json", "No run.json in this run"),
        ("videos/success_000.mp4", "Left out: videos/success_000.mp4 is not there."),
    ],
)
def test_missing_part_leaves_a_note(run_dir: Path, missing: str, note: str) -> None:
    path = run_dir / missing
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    assert note in written(run_dir).text


def test_one_part_is_enough(run_dir: Path) -> None:
    for path in run_dir.iterdir():
        if path.name != "evaluation.json":
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    page = written(run_dir)
    assert "18 / 20" in page.text
    assert len(page.all("img")) == 1


def test_evaluation_without_videos_or_placements_is_shown(
    run_dir: Path, edit_json: EditJson
) -> None:
    rows = [{"episode": 0, "outcome": "success"}]
    edit_json(run_dir / "evaluation.json", {"videos": [], "episodes": rows})
    assert "The evaluation made no videos." in written(run_dir).text


def test_failures_are_shown_by_kind_with_how_far_they_came_and_what_was_seen(
    run_dir: Path, edit_json: EditJson, small_png: bytes
) -> None:
    (run_dir / "evaluation_failures").mkdir()
    (run_dir / "evaluation_failures" / "000.png").write_bytes(small_png)
    rows = [
        {
            "episode": k,
            "outcome": "failure",
            "reason": f"peg {20 + 10 * k} mm beside the hole",
            "progress": {"waypoint": 30 + k, "of": 60, "seconds": 4.0 + k},
            "final_image": f"evaluation_failures/{k:03d}.png",
        }
        for k in range(3)
    ]
    edit_json(run_dir / "evaluation.json", {"videos": [], "episodes": rows})
    page = written(run_dir)
    assert "3 × peg 30 mm beside the hole" in page.text
    assert "waypoint 31, after 5.0" in page.text
    # Of the other two no image is there.
    alts = [shown["alt"] for shown in page.all("img")]
    assert "What overview and wrist camera saw at the end of 1 failed rollout" in alts


def test_of_many_kinds_of_failure_the_first_have_images(
    run_dir: Path, edit_json: EditJson, small_png: bytes
) -> None:
    (run_dir / "evaluation_failures").mkdir()
    rows = []
    for k, reason in enumerate(("lost", "stuck", "late", "beside", "above", "below")):
        name = f"evaluation_failures/{k:03d}.png"
        (run_dir / name).write_bytes(small_png)
        rows.append({"episode": k, "outcome": "failure", "reason": reason, "final_image": name})
    edit_json(run_dir / "evaluation.json", {"videos": [], "episodes": rows})
    page = written(run_dir)
    alts = [shown["alt"] for shown in page.all("img")]
    assert sum(alt.startswith("What overview and wrist camera saw") for alt in alts) == 4
    assert "1 × lost" in page.text and "1 × below" in page.text


def test_demonstration_without_images_leaves_a_note(
    run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load = report.load_demonstration

    def blind(path: Path) -> Any:
        demonstration = load(path)
        object.__setattr__(demonstration.steps, "cameras", {})
        return demonstration

    monkeypatch.setattr(report, "load_demonstration", blind)
    (run_dir / "annotation.json").unlink()
    assert "The demonstration holds no camera images." in written(run_dir).text


def test_large_videos_are_named_instead_of_carried(
    run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    size = (run_dir / "videos" / "success_000.mp4").stat().st_size
    monkeypatch.setattr(report, "MAX_VIDEO_BYTES", size)
    page = written(run_dir)
    assert len(page.all("video")) == 1
    assert "Too large to be part of this page: videos/failure_000.mp4" in page.text
    links = [a["href"] for a in page.all("a") if not a["href"].startswith("#")]
    assert links == ["videos/failure_000.mp4"]
    assert (run_dir / links[0]).is_file()


def test_a_film_that_is_none_is_named(run_dir: Path) -> None:
    (run_dir / "videos" / "failure_000.mp4").write_bytes(b"no film")
    with pytest.raises(BrokenFile, match="failure_000.mp4: can't be read as a video"):
        written(run_dir)


def test_films_say_why_rollouts_failed_or_that_none_did(run_dir: Path, edit_json: EditJson) -> None:
    text = written(run_dir).text
    assert "✗ failure episode 6: time limit: peg beside the hole" in text
    assert "No rollout failed" not in text
    edit_json(run_dir / "evaluation.json", {"n_success": 20})
    assert "No rollout failed" in written(run_dir).text


def test_the_page_is_made_without_a_robot_that_can_not_be_found_and_says_so(run_dir: Path) -> None:
    def lost(demonstration: Demonstration) -> Any:
        raise UnknownName("robot 'mine': not found; pass --robot")

    out = run_dir / "report.html"
    write_report(run_dir, out, lost)
    page = Page(out.read_text())
    assert "Robot and scene are not shown: robot 'mine': not found; pass --robot." in page.text
    assert "robot" not in [box["data-layer"] for box in page.all("input") if "data-layer" in box]


def test_the_largest_radius_that_may_be_suggested_is_said_in_words(run_dir: Path) -> None:
    path = run_dir / "annotation.json"
    path.write_text(path.read_text().replace("gripper - table", "max_radius"))
    assert "80.0 mm the largest radius that may be suggested" in written(run_dir).text


def test_rejections_are_told_by_sphere_and_reason(run_dir: Path) -> None:
    row = "gripper - table 4 3 1 × joint jump 2 × path too close peg / block 90.0 mm"
    assert row in written(run_dir).text


def test_a_whole_page_with_robot_scene_and_films_is_at_most_3_mb(
    run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task, robot = get_task("peg_in_hole"), get_robot("ur5e_2f85")
    monkeypatch.setattr(report, "scene_image", scene_image)
    # As much film as a page takes, most of it an MP4 box that players skip.
    films = [run_dir / "videos" / f"{name}_000.mp4" for name in ("success", "failure")]
    n = report.MAX_VIDEO_BYTES - sum(film.stat().st_size for film in films)
    with films[0].open("ab") as film:
        film.write(n.to_bytes(4, "big") + b"free" + bytes(n - 8))
    write_report(run_dir, run_dir / "report.html", lambda _: (robot, task.scene))
    page = Page((run_dir / "report.html").read_text())
    assert len(page.all("video")) == 2
    assert len(page.source.encode()) <= 3e6
    carried = sum(len(video["src"]) for video in page.all("video"))
    assert len(page.source.encode()) - carried <= 1.5e6


def test_human_radii_count_as_human_time(run_dir: Path, edit_json: EditJson) -> None:
    path = run_dir / "annotation.json"
    path.write_text(path.read_text().replace('"suggested"', '"human"'))
    edit_json(path, {"seconds_spent": 30.0})
    page = written(run_dir)
    assert "30.0 s annotating" in page.text
    assert "Human time30.0 s" in page.text


def test_only_a_person_s_demonstration_counts_as_human_time(run_dir: Path) -> None:
    assert "Human timenone" in written(run_dir).text
    demonstration = load_demonstration(run_dir / "demo.h5")
    by_hand = dataclasses.replace(demonstration, device="keyboard", operator="Ada", seconds=34.2)
    save_demonstration(run_dir / "demo.h5", by_hand)
    page = written(run_dir)
    assert "Human time34.2 s" in page.text and "34.2 s demonstrating" in page.text
    assert "steered by Ada" in page.text


def test_a_video_that_ended_otherwise_than_its_rollout_says_so(
    run_dir: Path, edit_json: EditJson
) -> None:
    path = "videos/success_000.mp4"
    video = {"path": path, "episode": 3, "outcome": "success", "evaluated_outcome": "failure"}
    edit_json(run_dir / "evaluation.json", {"videos": [video]})
    words = "episode 3, run again for the video; when it was evaluated it was a failure"
    assert words in written(run_dir).text


def test_an_interrupted_generation_has_no_time_and_no_rate(
    run_dir: Path, edit_json: EditJson
) -> None:
    assert "kept each second" in written(run_dir).text
    edit_json(run_dir / "dataset" / "dataset.json", {"seconds": None})
    text = written(run_dir).text
    assert "were kept (80 %)." in text and "kept each second" not in text


def test_hostile_text_stays_text(run_dir: Path, edit_json: EditJson) -> None:
    evaluation = {
        "task": HOSTILE,
        "policy": HOSTILE,
        "episodes": [
            {"episode": 0, "seed": HOSTILE, "outcome": "failure", "reason": HOSTILE,
             "placement": {HOSTILE: {"x": 0.0, "y": 0.0}}, "steps": 3},
            {"episode": 1, "seed": 1, "outcome": "success"},
        ],
        "versions": {HOSTILE: HOSTILE},
    }  # fmt: skip
    edit_json(run_dir / "evaluation.json", evaluation)
    edit_json(run_dir / "run.json", {"command": HOSTILE, "machine": {HOSTILE: HOSTILE}})
    spheres = json.loads((run_dir / "annotation.json").read_text())["spheres"]
    hostile = [{**sphere, "limited_by": f"a_b {HOSTILE}"} for sphere in spheres]
    edit_json(run_dir / "annotation.json", {"spheres": hostile})
    page = written(run_dir)
    assert HOSTILE not in "".join(page.scripts)
    assert len(page.all("script")) == 3
    assert not any("onload" in attributes for _, attributes in page.elements)
    assert HOSTILE in "".join(page.words)
    for _, attributes in page.elements:
        assert attributes.get("src", "data:").startswith("data:")


def test_video_outside_the_run_is_refused(run_dir: Path, edit_json: EditJson) -> None:
    video = {"path": "../../secret.mp4", "episode": 0, "outcome": "success"}
    edit_json(run_dir / "evaluation.json", {"videos": [video]})
    with pytest.raises(BrokenFile, match=r"evaluation.json: .*`\$.videos\[0\].path`"):
        write_report(run_dir, run_dir / "report.html")
    assert not (run_dir / "report.html").exists()


@pytest.mark.parametrize(
    ("file", "changes", "error", "message"),
    [
        ("evaluation.json", {"ci95": None}, BrokenFile, "evaluation.json: .*`\\$.ci95`"),
        ("evaluation.json", {"n_episodes": 0}, BrokenFile, "`\\$.n_episodes`"),
        ("evaluation.json", {"episodes": [{}]}, BrokenFile, "evaluation.json: .*`episode`"),
        ("skill/training.json", {"curve": []}, BrokenFile, "its curve has no epoch"),
        ("skill/training.json", {"curve": [{}]}, BrokenFile, "training.json: .*`epoch`"),
        ("run.json", {"stages": {"train": "long"}}, BrokenFile, "run.json: .*`\\$.stages"),
        ("annotation.json", {"demonstration_hash": "0"}, Mismatch, "another demonstration"),
    ],
)
def test_damaged_part_is_an_error(
    run_dir: Path,
    edit_json: EditJson,
    file: str,
    changes: dict[str, Any],
    error: type[Exception],
    message: str,
) -> None:
    edit_json(run_dir / file, changes)
    with pytest.raises(error, match=message):
        write_report(run_dir, run_dir / "report.html")


def test_file_that_is_no_json_is_an_error(run_dir: Path) -> None:
    (run_dir / "evaluation.json").write_text("{")
    with pytest.raises(BrokenFile, match="not readable as JSON"):
        write_report(run_dir, run_dir / "report.html")


def test_no_run_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(MissingFile, match="no such directory; pass one that `sart run` wrote"):
        write_report(tmp_path / "nowhere", tmp_path / "report.html")
    with pytest.raises(MissingFile, match="holds no part of a run"):
        write_report(tmp_path, tmp_path / "report.html")


def test_page_that_can_not_be_written_is_an_error(run_dir: Path) -> None:
    with pytest.raises(CannotWrite, match="report.html"):
        write_report(run_dir, run_dir / "run.json" / "report.html")


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0, "0.0 s"), (9.64, "9.6 s"), (59.96, "1 min 00 s"), (212, "3 min 32 s"),
        (3599.6, "1 h 00 min"), (7500, "2 h 05 min"),
    ],
)  # fmt: skip
def test_durations_read_naturally(seconds: float, words: str) -> None:
    assert duration(seconds).replace("\N{NO-BREAK SPACE}", " ") == words


def test_percentages_read_naturally() -> None:
    shares = [percent(share).replace("\N{NO-BREAK SPACE}", " ") for share in (0, 0.8, 0.9287, 1)]
    assert shares == ["0 %", "80 %", "92.9 %", "100 %"]


@pytest.mark.parametrize(
    ("metres", "at_least", "at_most"),
    [
        (0.0002, "0.20", "0.20"),
        (0.00125, "1.25", "1.25"),
        (0.0012549, "1.25", "1.26"),
        (0, "0.00", "0.00"),
    ],
)
def test_bounds_are_rounded_to_where_they_still_hold(
    metres: float, at_least: str, at_most: str
) -> None:
    assert at_least_mm(metres) == f"{at_least}\N{NO-BREAK SPACE}mm"
    assert at_most_mm(metres) == f"{at_most}\N{NO-BREAK SPACE}mm"
