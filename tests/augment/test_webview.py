"""A generation on a page: what is told of it, what is shown, and that no page stops it."""

from __future__ import annotations

import importlib
import json
import re
import socket

import numpy as np
import pytest

from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.engine import augment_demonstration
from sart_toolkit.augment.planner import draw_proposal
from sart_toolkit.cli import main
from sart_toolkit.data.manifest import KEPT, AttemptKey
from sart_toolkit.data.storage import save_annotation, save_demonstration
from sart_toolkit.testing.browser import MESSAGE

CROWDED = AugmentConfig(n=5, seed=3, duration=0.8)


@pytest.fixture
def generate(peg_demonstration, crowded, make_peg_backend, tmp_path):
    """Generates a small dataset, some of whose attempts are rejected."""

    def generate(**options):
        return augment_demonstration(
            peg_demonstration, crowded, make_peg_backend, tmp_path / "dataset", CROWDED, **options
        )

    return generate


@pytest.fixture
def webview():
    pytest.importorskip("viser")
    return importlib.import_module("sart_toolkit.augment.webview")


@pytest.fixture
def make_view(webview, peg_demonstration, crowded, peg_model, peg_task, tmp_path, free_port):
    """Opens the page about that dataset."""

    def make(port=free_port):
        return webview.GenerationView(
            [(peg_demonstration, crowded)], CROWDED, peg_model.spec, peg_task.scene,
            tmp_path / "dataset", port=port,
        )  # fmt: skip

    return make


def interrupt(kept, wanted, rejected):
    if kept + rejected == 3:
        raise KeyboardInterrupt


def test_every_attempt_is_told_of_once_those_before_an_interruption_first(generate):
    told, again = [], []
    with pytest.raises(KeyboardInterrupt):
        generate(watch=lambda *attempt: told.append(attempt), progress=interrupt)
    data = generate(watch=lambda *attempt: again.append(attempt))
    assert len(told) == 3 and sorted(again[:3]) == sorted(told)
    assert len({key for key, _ in again}) == len(again) == data.info["n_attempted"]
    kept = {key for key, outcome in again if outcome == KEPT}
    assert kept == {entry.key for entry in data.index} and len(kept) < len(again)
    reasons = [outcome for _, outcome in again if outcome != KEPT]
    assert {reason: reasons.count(reason) for reason in reasons} == data.info["rejections"]


def test_what_is_drawn_for_an_attempt_is_known_without_its_episode(generate, crowded):
    data = generate()
    demonstration = data.sources[0].demonstration
    for episode in data:
        p = episode.provenance
        key = AttemptKey(p.source, p.sphere, p.k)
        drawn, _ = draw_proposal(demonstration, crowded.spheres, key, CROWDED)
        np.testing.assert_array_equal(drawn.T_world_sampled, p.T_world_sampled)
        assert drawn.t_star == p.t_star


def test_the_page_counts_what_each_sphere_gave(generate, make_view):
    with make_view() as view:
        data = generate(watch=view)
        view._shown.draw()
        said = view._shown._state.content
    rows = data.info["by_sphere"]
    kept = sum(row["kept"] for row in rows)
    rejected = sum(data.info["rejections"].values())
    assert rejected and f"{kept} of 4 kept, {rejected} rejected" in said
    for i, row in enumerate(rows):
        cells = f"<td>{row['kept']} of {row['wanted']}</td>"
        cells += f"<td>{sum(row['rejections'].values())}</td>"
        assert re.search(rf"<td>{i}</td><td>{row['waypoint']}</td><td>[\d.]+ mm</td>{cells}", said)
    for reason in data.info["rejections"]:
        assert reason.replace("'", "&#x27;") in said
    # Kept segments are drawn as they were measured.
    for episode in data:
        p = episode.provenance
        path = view._shown._paths[AttemptKey(p.source, p.sphere, p.k)]
        np.testing.assert_array_equal(path, episode.steps.measured_Ts_world_tool[:, :3, 3])


def test_without_a_page_it_goes_on(generate, make_view, caplog):
    with socket.create_server(("127.0.0.1", 0)) as other, make_view(other.getsockname()[1]) as view:
        assert not view.how_to_open
        data = generate(watch=view)
    assert len(data) == 4
    (said,) = [r.message for r in caplog.records if "no page in the browser" in r.message]
    assert "can't serve a page there" in said and "goes on without" in said


def test_a_page_that_can_t_be_drawn_is_left_and_it_goes_on(
    generate, make_view, webview, caplog, monkeypatch
):
    with make_view() as view:
        monkeypatch.setattr(webview.GenerationPage, "attempted", lambda *_: 1 / 0)
        data = generate(watch=view)
    assert len(data) == 4
    assert sum("no page in the browser" in record.message for record in caplog.records) == 1


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--host", "0.0.0.0"], "--host: says where the page of --web is; add --web"),
        (["--web", "--dry-run"], "--web and --dry-run: choose one of them"),
    ],
)
def test_options_that_exclude_each_other_are_refused(capsys, tmp_path, options, said):
    with pytest.raises(SystemExit) as exit_:
        main(["augment", str(tmp_path / "demo.h5"), "--out", str(tmp_path / "d"), *options])
    assert exit_.value.code == 2 and said in capsys.readouterr().err


@pytest.mark.window
@pytest.mark.slow
def test_a_generation_is_watched_in_a_browser_and_goes_on_when_that_is_closed(
    serve, browser, tmp_path, peg_demonstration, peg_annotation, wait_until
):
    save_demonstration(tmp_path / "demo.h5", peg_demonstration)
    save_annotation(tmp_path / "annotation.json", peg_annotation)
    program = serve(
        "augment", tmp_path / "demo.h5", tmp_path / "annotation.json",
        "--out", tmp_path / "dataset", "--n", 400,
    )  # fmt: skip
    browser.open_page(program.url)
    kept = f"parseInt(document.querySelector('{MESSAGE}').innerText)"
    first = browser.wait_for(kept)
    browser.wait_for(f"{kept} > {first}")
    browser.open("about:blank")
    out, err = program.communicate(timeout=300)
    assert program.returncode == 0, err
    assert json.loads(out)["n_trajectories"] == 400 and "no page" not in err
