"""What every key of the annotator does, without a window; what a crash leaves."""

from __future__ import annotations

import copy
import dataclasses
import json
import os
import signal
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sart_toolkit.annotate.session import (
    ACTIONS,
    KEYS,
    AnnotateConfig,
    AnnotationSession,
)
from sart_toolkit.annotate.suggest import suggest_annotation, suggest_radius
from sart_toolkit.data.records import PrecisionSphere, convergence_waypoint
from sart_toolkit.data.sampling import sample_in_region, sample_pose
from sart_toolkit.data.storage import (
    Journal,
    annotation_to_json,
    append_json_line,
    load_annotation,
    save_annotation,
    save_demonstration,
)
from sart_toolkit.errors import BrokenFile, CannotWrite, InvalidInput, Mismatch, UnknownName


@pytest.fixture(scope="module")
def prepared(peg_demonstration, peg_world):
    """Everything computed ahead, to be shared by sessions: the scene is the same."""
    session = AnnotationSession(peg_demonstration, peg_world)
    while session.prepare():
        pass
    _ = session.clearances
    return session


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def open_session(prepared, tmp_path):
    """A session on `tmp_path/a.json` with its journal; open it again as after a crash."""
    opened = []

    def make(annotation=None, journal=True, **changes):
        for old in opened:
            old._journal and old._journal.close()
        session = AnnotationSession(
            prepared.demonstration,
            prepared._world,
            annotation=annotation,
            out=tmp_path / "a.json",
            journal=Journal(tmp_path / "a.json.journal") if journal else None,
            **{"clock": Clock(), **changes},
        )
        for name in ("_found", "_suggested", "clearances"):
            session.__dict__[name] = prepared.__dict__[name]
        opened.append(session)
        return session

    yield make
    for session in opened:
        session.close()


@pytest.fixture
def session(open_session):
    return open_session()


def press(session, *keys):
    for key in keys:
        assert session.press(key), key


def waypoints(session):
    return [s.waypoint for s in session.spheres]


def rows(spheres):
    return [(s.waypoint, s.radius, s.kind, s.source, s.clearance, s.limited_by) for s in spheres]


# --- the keys -----------------------------------------------------------------------------------


def test_every_key_does_one_thing_and_says_what(prepared):
    keys = [key for action in ACTIONS.values() for key in action.keys]
    assert len(keys) == len(set(keys)) == len(KEYS)
    assert all(action.help for action in ACTIONS.values())
    assert all(bool(action.keys) != action.takes_number for action in ACTIONS.values())


def test_arrows_pages_home_and_end_step_through_the_waypoints(session):
    for key, t in [("Right", 1), ("Right", 2), ("Left", 1), ("Page Down", 11), ("Page Up", 1),
                   ("Page Up", 0), ("Left", 0), ("End", session.last), ("Right", session.last),
                   ("Home", 0)]:  # fmt: skip
        press(session, key)
        assert session.selected == t and not session.refused and session.state()
    assert session.spheres == () and not session.dirty


def test_n_and_p_lead_from_sphere_to_sphere(session):
    press(session, "A", "N")
    assert session.selected == waypoints(session)[1]
    press(session, "P")
    assert session.selected == waypoints(session)[0]
    press(session, "P")
    assert session.refused and "no previous sphere" in session.message
    press(session, "End", "N")
    assert session.refused and session.selected == session.last


def test_c_leads_to_where_the_segments_start(session, prepared):
    press(session, "C")
    assert session.refused and "add one first" in session.message
    press(session, "Enter", "Right", "C")
    sphere = session.spheres[0]
    assert session.selected == convergence_waypoint(prepared.demonstration, sphere)


@pytest.mark.parametrize("key", ["Enter", "Space"])
def test_a_sphere_put_by_hand_has_the_first_radius_or_what_is_safe(session, key):
    press(session, key)
    assert rows(session.spheres) == [(0, 0.04, "ball", "human", None, None)]
    assert session.dirty and session.verdict(session.sphere).word == "safe"
    press(session, key)
    assert session.refused and "already" in session.message
    session.perform("go", 26)
    press(session, key)
    here = session.sphere.radius
    assert here == np.floor(1e3 * session.largest_safe(26).radius) / 1e3 < 0.04
    press(session, "End", key)
    assert session.refused and len(session.spheres) == 2


@pytest.mark.parametrize("key", ["Backspace", "Delete"])
def test_a_sphere_is_removed(session, key):
    press(session, key)
    assert session.refused and "no sphere at waypoint 0" in session.message
    press(session, "Enter", key)
    assert session.spheres == () and not session.dirty


def test_the_radius_goes_up_and_down_in_coarse_and_fine_steps(session):
    press(session, "Up")
    assert session.refused
    press(session, "Enter")
    for key, mm in [("Up", 50), ("+", 51), ("-", 50), ("Down", 40), ("-", 39)]:
        press(session, key)
        assert session.sphere.radius == pytest.approx(mm / 1e3, abs=1e-12)
    press(session, *["Down"] * 5)
    assert session.refused and session.sphere.radius == session.config.smallest
    press(session, *["Up"] * 60)
    assert session.refused and session.sphere.radius == session.config.largest


def test_s_suggests_what_suggest_annotation_does(session, prepared):
    session.perform("go", 20)
    press(session, "S")
    (wanted,) = suggest_annotation(prepared.demonstration, prepared._world, [20]).spheres
    assert rows(session.spheres) == rows([wanted])
    assert session.sphere.source == "suggested" and session.sphere.clearance
    press(session, "End", "S")
    assert session.refused


def test_a_changed_radius_has_no_certificate_any_more(session):
    press(session, "S", "-")
    assert rows(session.spheres)[0][3:] == ("human", None, None)
    press(session, "Z")
    assert session.sphere.source == "suggested"


def test_a_suggests_all_and_one_undo_brings_the_former_back(session, peg_annotation):
    press(session, "Enter", "A")
    assert rows(session.spheres) == rows(peg_annotation.spheres)
    assert "in place of 1" in session.message
    press(session, "Z")
    assert rows(session.spheres) == [(0, 0.04, "ball", "human", None, None)]


def test_m_takes_the_largest_safe_radius_and_keeps_the_kind(session):
    press(session, "M")
    assert session.refused
    press(session, "Enter", "F", "M")
    sphere = session.sphere
    assert sphere.kind == "free_space" and sphere.source == "suggested"
    assert sphere.radius == pytest.approx(session.largest_safe(0).radius, abs=2e-6)
    before = session.spheres
    press(session, "M")
    assert session.spheres is before and "already" in session.message


def test_f_makes_a_free_space_region_and_a_ball_again(session):
    press(session, "F")
    assert session.refused
    press(session, "Enter", *["Up"] * 15, "F")
    assert session.sphere.kind == "free_space"
    assert session.verdict(session.sphere).word == "region"
    press(session, "F")
    assert session.sphere.kind == "ball"
    assert session.verdict(session.sphere).word == "colliding"


def test_undo_and_redo_lead_back_and_forth_with_the_waypoint(session):
    press(session, "Z")
    assert session.refused and "nothing to undo" in session.message
    press(session, "Enter", "Up", "Right", "Enter", "Home")
    states = [rows(session.spheres)]
    for where in (1, 0, 0):
        press(session, "Z")
        assert session.selected == where
        states.append(rows(session.spheres))
    assert states[-1] == [] and not session.dirty
    for state in reversed(states[:-1]):
        press(session, "Y")
        assert rows(session.spheres) == state
    press(session, "Y")
    assert session.refused and "nothing to redo" in session.message
    press(session, "Z", "Enter")
    press(session, "Z", "Left", "Backspace", "Y")
    assert session.refused


def test_t_g_and_v_change_the_view_only(session):
    before = rows(session.spheres)
    press(session, "T", "G")
    assert session.shown == "scene" and session.follow
    press(session, "T", "V")
    assert session.shown == "cloud" and not session.follow and session.view_resets == 1
    assert rows(session.spheres) == before and not session.dirty


def test_w_saves_what_loads_again_with_the_seconds_spent(session, open_session, tmp_path):
    press(session, "W")
    assert session.refused and "add one first" in session.message
    assert not (tmp_path / "a.json").exists()
    session._clock.now = 12.5
    press(session, "A", "W")
    saved = load_annotation(tmp_path / "a.json")
    saved.check_matches(session.demonstration)
    assert rows(saved.spheres) == rows(session.spheres) and saved.seconds == 12.5
    assert saved.settings == dataclasses.asdict(session.config.suggest)
    assert not session.dirty and session.presses == 3
    press(session, "Q")
    session.close()
    assert os.listdir(tmp_path) == ["a.json"]

    again = open_session(saved)
    again._clock.now = 2.0
    press(again, "Enter", "W")
    assert again.refused is False and load_annotation(tmp_path / "a.json").seconds == 14.5


def test_saving_names_the_spheres_that_are_not_proved_clear(session, tmp_path):
    press(session, "Enter", "W")
    assert "NOT proved" not in session.message and session.unproved == []
    session.perform("go", 26)
    press(session, "Enter")
    session.perform("radius", 60)
    press(session, "W")
    assert not session.refused and len(load_annotation(tmp_path / "a.json").spheres) == 2
    (named,) = session.unproved
    assert named.startswith("waypoint 26, 60.0 mm: colliding: up to ")
    assert session.message.endswith(f"; NOT proved clear: {named}")


@pytest.mark.parametrize("key", ["Q", "Escape"])
def test_leaving_asks_once_about_changes_that_are_not_saved(session, tmp_path, key):
    press(session, "Enter", key)
    assert not session.done and "aren't saved" in session.message
    press(session, "Right", key)
    assert not session.done
    press(session, key)
    assert session.done and session.message == "changes dropped"
    session.close()
    assert not (tmp_path / "a.json.journal").exists()


def test_leaving_without_changes_asks_nothing(session):
    press(session, "Right", "Q")
    assert session.done


def test_numbers_choose_a_waypoint_and_a_radius(session):
    session.perform("go", 7)
    press(session, "Enter")
    session.perform("radius", 12.5)
    assert rows(session.spheres)[0][:2] == (7, 0.0125)
    for name, value, message in [
        ("go", 7.5, "expected 0 to"), ("go", -1, "expected 0 to"), ("go", None, "a number after"),
        ("radius", 0, "1 to 500 mm"), ("radius", np.nan, "1 to 500 mm"), ("save", 3, "nothing aft"),
    ]:  # fmt: skip
        session.perform(name, value)
        assert session.refused and message in session.message
    assert rows(session.spheres)[0][:2] == (7, 0.0125)


def test_an_unknown_key_or_action_is_reported(session):
    assert not session.press("F1") and session.presses == 0
    with pytest.raises(UnknownName, match="unknown action 'suggestall': did you mean 'suggest-all"):
        session.perform("suggestall")


# --- verdicts -----------------------------------------------------------------------------------


def test_verdicts_agree_with_the_suggested_radius_at_every_waypoint(session, prepared):
    words = set()
    for t in range(session.last):
        found = suggest_radius(
            prepared._world,
            prepared.demonstration,
            t,
            dataclasses.replace(session.config.suggest, min_radius=session.config.smallest),
        )
        T = prepared.demonstration.steps.measured_Ts_world_tool[t]

        def verdict(radius, t=t, T=T, kind="ball"):
            return session.verdict(PrecisionSphere(t, T, radius, kind))

        if found.radius:
            assert verdict(0.99 * found.radius).word == "safe"
            assert verdict(1.01 * found.radius + 2e-6).word in ("tight", "colliding")
            assert found.limited_by in str(verdict(found.radius))
        assert verdict(1.01 * found.clearance).word == "colliding"
        assert verdict(0.4, kind="free_space").word == "region"
        words |= {verdict(s * found.clearance).word for s in (0.5, 0.99, 1.01)}
    assert words == {"safe", "tight", "colliding"}


def test_during_a_contact_there_is_no_room(prepared):
    touching = dataclasses.replace(
        prepared._world.phases[0], contacts=frozenset({("peg", "block")})
    )

    world = copy.copy(prepared._world)
    world.phases = (touching,) * len(prepared.demonstration)
    session = AnnotationSession(prepared.demonstration, world)
    assert session.state()["verdict"] == "no room: contact peg / block"
    assert session.state()["phase"] == "touches peg / block"
    press(session, "Enter")
    assert session.verdict(session.sphere).word == "no room"
    press(session, "F", "S")
    assert session.refused and session.verdict(session.sphere).word == "no room"
    press(session, "A")
    assert session.refused and "no waypoint has room" in session.message


def test_the_path_s_clearance_is_that_of_the_nearest_pair(session, peg_world):
    for t in (0, 10, 25, session.last):
        q = session.demonstration.steps.joint_positions[t]
        nearest = peg_world.placed(t).tool_clearances(q)[0].distance
        assert session.clearances[t] == pytest.approx(nearest, abs=1e-6)


def test_ghosts_are_poses_that_the_augmentation_draws(session):
    press(session, "Enter")
    for kind, draw in (("ball", sample_pose), ("free_space", sample_in_region)):
        sphere = dataclasses.replace(session.sphere, kind=kind)
        rng = np.random.default_rng([0, 0])
        wanted = [draw(sphere, rng, session.config.sampling) for _ in range(3)]
        np.testing.assert_array_equal(session.ghosts(sphere), wanted)
    none = AnnotateConfig(ghosts=0)
    assert AnnotationSession(session.demonstration, session._world, none).ghosts(
        session.sphere
    ).shape == (0, 4, 4)


def test_impossible_settings_are_refused():
    with pytest.raises(InvalidInput, match="coarse: expected a finite number > 0"):
        AnnotateConfig(coarse=0.0)
    with pytest.raises(InvalidInput, match="first_radius: expected 0.001 to 0.5 m, got 0.6"):
        AnnotateConfig(first_radius=0.6)
    with pytest.raises(InvalidInput, match="ghosts: expected a whole number >= 0, got -1"):
        AnnotateConfig(ghosts=-1)


# --- undo and recovery as properties ------------------------------------------------------------

sequences = st.lists(
    st.one_of(
        st.sampled_from([n for n, a in ACTIONS.items() if not a.takes_number and n != "quit"]),
        st.tuples(st.just("go"), st.integers(-1, 47)),
        st.tuples(st.just("radius"), st.integers(0, 200)),
    ),
    max_size=25,
)


def do_all(session, actions):
    for action in actions:
        session.perform(*([action] if isinstance(action, str) else action))


@settings(
    max_examples=40, deadline=None, derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)  # fmt: skip
@given(actions=sequences)
def test_undoing_all_leads_back_to_the_start(open_session, peg_annotation, actions):
    session = open_session(peg_annotation, journal=False)
    do_all(session, actions)
    while session._undo:
        session.perform("undo")
        assert waypoints(session) == sorted(set(waypoints(session)))
    assert rows(session.spheres) == rows(peg_annotation.spheres)


@settings(
    max_examples=40, deadline=None, derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)  # fmt: skip
@given(actions=sequences)
def test_a_journal_done_again_equals_the_live_state(open_session, tmp_path, actions):
    for path in tmp_path.iterdir():
        path.unlink()
    session = open_session()
    do_all(session, actions)
    file = tmp_path / "a.json"
    again = open_session(load_annotation(file) if file.exists() else None)
    assert again.selected == session.selected and again.dirty == session.dirty
    assert again.presses == session.presses
    for a, b in (("spheres", None), ("_undo", 1), ("_redo", 1)):
        live, replayed = getattr(session, a), getattr(again, a)
        if b:
            live, replayed = ([rows(s) for _, s in each] for each in (live, replayed))
            assert live == replayed
        else:
            assert rows(live) == rows(replayed)


def test_an_interrupted_session_resumes_and_says_so(session, open_session, tmp_path):
    session._clock.now = 30.0
    press(session, "A", "Right", "Backspace", "Home", "Up")
    again = open_session()
    assert "recovered the 5 key presses" in again.message and "not saved yet" in again.message
    assert rows(again.spheres) == rows(session.spheres) and again.seconds == 30.0
    press(again, "Z")
    assert rows(again.spheres) == rows(session._undo[-1][1])
    press(again, "W", "Q")
    again.close()
    assert not (tmp_path / "a.json.journal").exists()


def test_a_row_that_was_cut_short_is_left_out_and_written_over(session, open_session, tmp_path):
    press(session, "Enter", "Up")
    with open(tmp_path / "a.json.journal", "a") as file:
        file.write('{"action": "grow", "sel')
    again = open_session()
    assert rows(again.spheres) == rows(session.spheres)
    press(again, "Up")
    assert rows(open_session().spheres) == rows(again.spheres)


def test_a_file_that_was_changed_meanwhile_is_one_undo_away(session, open_session, tmp_path):
    press(session, "A")
    other = session.annotation()
    other = dataclasses.replace(other, spheres=other.spheres[:1])
    save_annotation(tmp_path / "a.json", other)
    for _ in range(2):
        again = open_session(other)
        assert again.dirty and rows(again.spheres) == rows(session.spheres)
    press(again, "Z")
    assert not again.dirty and rows(again.spheres) == rows(other.spheres)


def test_one_process_at_a_time_works_on_an_annotation(session, tmp_path):
    with pytest.raises(CannotWrite, match="another process is using it"):
        Journal(tmp_path / "a.json.journal")


def test_a_journal_of_something_else_is_refused(session, open_session, tmp_path):
    path = tmp_path / "a.json.journal"
    press(session, "Enter")
    header, row = path.read_text().splitlines()
    for lines, kind, message in [
        ([{**json.loads(header), "demonstration_hash": "x"}, row], Mismatch, "another demonstrat"),
        ([header, {"action": "grow"}], BrokenFile, "not a journal.*remove"),
        ([header, {**json.loads(row), "selected": 99}], BrokenFile, "not a journal"),
        ([header, {**json.loads(row), "spheres": [{"waypoint": 99}]}], BrokenFile, "not a journ"),
    ]:  # fmt: skip
        rows = [json.loads(x) if isinstance(x, str) else x for x in lines]
        path.unlink()
        for row in rows:
            append_json_line(path, {k: v for k, v in row.items() if k != "check"})
        with pytest.raises(kind, match=message):
            open_session()


def test_another_demonstration_s_annotation_is_refused(open_session, peg_annotation):
    other = dataclasses.replace(peg_annotation, demonstration_hash="0" * 64)
    with pytest.raises(Mismatch, match="made for another demonstration"):
        open_session(other, journal=False)


def test_a_full_disk_keeps_the_session(session, monkeypatch, tmp_path):
    press(session, "A")

    def refuse(*args):
        raise CannotWrite("a.json: No space left on device; make room")

    monkeypatch.setattr("sart_toolkit.annotate.session.save_annotation", refuse)
    monkeypatch.setattr(session._journal, "append", refuse)
    press(session, "W")
    assert session.refused and "No space left" in session.message
    assert "a crash would lose this" in session.message
    assert session.dirty and len(session.spheres) > 1
    monkeypatch.undo()
    press(session, "W")
    assert not session.dirty and load_annotation(tmp_path / "a.json").spheres


def test_a_row_that_found_no_room_leaves_nothing_behind(tmp_path, monkeypatch):
    journal = Journal(tmp_path / "j")
    journal.append({"n": 1})

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("sart_toolkit.data.storage.os.fsync", full)
    with pytest.raises(CannotWrite, match="No space left"):
        journal.append({"n": 2})
    monkeypatch.undo()
    journal.append({"n": 3})
    journal.close()
    again = Journal(tmp_path / "j")
    assert again.rows == [{"n": 1}, {"n": 3}]
    again.close(remove=True)
    with pytest.raises(CannotWrite, match="choose another --out"):
        Journal(tmp_path)


KILLED = textwrap.dedent(
    """
    import itertools, sys
    from pathlib import Path
    from sart_toolkit.robots import get_robot
    from sart_toolkit.collision.exact import ExactWorld
    from sart_toolkit.data.storage import Journal, load_demonstration
    from sart_toolkit.tasks import get_task
    from sart_toolkit.annotate.session import AnnotationSession

    demonstration = load_demonstration(Path(sys.argv[1]))
    robot, scene = get_robot(demonstration.robot), get_task(demonstration.task).scene
    world = ExactWorld(demonstration, robot, scene)
    session = AnnotationSession(
        demonstration, world, out=Path(sys.argv[2]), journal=Journal(Path(sys.argv[3]))
    )
    for key in itertools.cycle(["Enter", "+", "Right", "Enter", "-", "Z", "Right", "P", "Up", "F"]):
        print("before", flush=True)
        session.press(key)
        state = [[s.waypoint, s.radius, s.kind] for s in session.spheres]
        print(session.presses, session.selected, state, sep=";", flush=True)
    """
)


def test_a_kill_at_any_moment_loses_the_last_key_press_at_most(open_session, tmp_path, prepared):
    save_demonstration(tmp_path / "demo.h5", prepared.demonstration)
    paths = [tmp_path / name for name in ("demo.h5", "a.json", "a.json.journal")]
    program = tmp_path / "killed.py"
    program.write_text(KILLED)
    rng = np.random.default_rng(0)
    for wait_presses in (int(n) for n in rng.integers(1, 60, 3)):
        process = subprocess.Popen(
            [sys.executable, program, *paths], stdout=subprocess.PIPE, text=True
        )
        lines = []
        for line in process.stdout:
            lines.append(line)
            if len(lines) >= 2 * wait_presses:
                break
        process.send_signal(signal.SIGKILL)
        lines += process.communicate()[0].splitlines(keepends=True)
        printed = [x.strip().split(";") for x in lines if x.endswith("\n") and ";" in x]
        session = open_session()
        presses, selected, state = printed[-1]
        assert session.presses in (int(presses), int(presses) + 1)
        if session.presses == int(presses):
            assert session.selected == int(selected)
            assert state == str([[s.waypoint, s.radius, s.kind] for s in session.spheres])
        session._journal.close(remove=True)


def test_what_is_saved_can_be_read_and_edited(session, tmp_path):
    press(session, "A", "W")
    file = json.loads((tmp_path / "a.json").read_text())
    assert file["schema_version"] and file["seconds_spent"] == 0.0
    assert {k: v for k, v in file.items() if k != "schema_version"} == annotation_to_json(
        session.annotation()
    )
