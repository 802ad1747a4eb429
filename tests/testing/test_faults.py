"""The suite names what is wrong with a backend: one fault fails one test, and no other."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROBOT = "ur5e_hande"

# What is wrong, and the test that must say so.
FAULTS = {
    "CameraOfOpenGL": "test_bodies_appear_where_the_camera_s_pose_has_them",
    "DepthInMillimetres": "test_depth_is_in_metres",
    "BlueGreenRed": "test_colours_are_red_green_and_blue_in_order",
    "StuckJoint": "test_commanded_joints_are_reached",
    "WrongClock": "test_a_step_advances_time_by_one_control_period",
    "ToolIsTheFlange": "test_the_tool_is_where_kinematics_have_it",
    "NoisySteps": "test_the_same_commands_give_the_same_trajectory",
    "NoContacts": "test_contact_is_reported_when_bodies_touch",
    "HingesWithoutFriction": "test_dry_friction_holds_against_less",
    "RestoreForgetsBodies": "test_restore_returns_bodies",
    "SaysItSentMore": "test_a_command_returns_what_was_sent",
    "CloseOnlyOnce": "test_closing_twice_does_nothing",
}

# Run with -m slow: five seconds each.
MORE_FAULTS = {
    "WideFieldOfView": "test_bodies_appear_as_the_field_of_view_has_them",
    "JointPathIsLate": "test_the_joint_path_leads_from_one_observation_to_the_next",
    "HeldLeftBehind": "test_what_is_held_moves_rigidly_with_the_robot",
    "ClippedCommands": "test_a_bad_command_is_refused_and_changes_nothing",
    "GripperInverted": "test_the_gripper_goes_where_commanded",
    "PhantomContact": "test_nothing_touches_in_free_space",
    "EarlyContacts": "test_contact_is_not_reported_a_millimetre_before",
    "RestoreForgetsTargets": "test_restore_returns_the_commands_in_force",
    "HistoryInTheBytes": "test_a_restored_state_is_saved_as_the_same_bytes",
    "NoBodiesAfterAll": "test_an_ability_that_a_backend_has_works",
    "SilentlyWithoutImages": "test_a_backend_takes_images_or_says_why_not",
    "DrawsThePresent": "test_a_drawn_state_appears_as_the_state_does",
    "DrawingResets": "test_drawing_changes_nothing",
    "RatesOfItsOwn": "test_rates_are_those_asked_for",
    "CloseReachesTheNext": "test_closing_one_instance_leaves_others_alone",
    "DepthAlongTheRay": "test_depth_is_along_the_camera_s_axis",
    "FarthestDepthForNothing": "test_depth_is_zero_where_nothing_was_hit",
    "DepthUpsideDown": "test_depth_and_colour_show_the_same",
    "CameraPoseOfItsFrame": "test_a_camera_s_reported_pose_is_that_of_its_frame",
    "WristCameraStays": "test_the_wrist_camera_moves_with_the_tool",
    "LateJoints": "test_joints_follow_at_the_commanded_speed",
    "JointPathSinceTheReset": "test_the_joint_path_leads_from_one_observation_to_the_next",
    "JointPathOutlivesARestore": "test_the_joint_path_leads_from_one_observation_to_the_next",
    "InstancesShareTargets": "test_two_instances_are_independent",
    "GripperClosesHalfWay": "test_the_fingers_are_as_far_apart_as_the_gripper_s_value_says",
    "GripperTooFast": "test_the_gripper_moves_no_faster_than_its_speed",
    "SlipperyFingers": "test_what_is_grasped_is_lifted",
    "StaticContacts": "test_bodies_that_never_move_do_not_touch",
    "DrawerTouchesItsRail": "test_a_jointed_body_does_not_touch_what_it_moves_on",
    "ContactsInAnyOrder": "test_contacts_are_in_order_of_their_names",
    "ContactsSinceTheReset": "test_contacts_are_those_of_the_last_step",
    "ContactsOutliveTheReset": "test_nothing_has_touched_after_a_reset",
    "FreeBodiesTouchNothing": "test_a_free_body_touches_what_it_stands_on",
    "ForcesInKilograms": "test_contact_forces_are_in_newtons",
    "SpringsHalfAsStiff": "test_a_spring_pulls_with_its_stiffness",
    "DetentsOnlyDrawIn": "test_a_detent_pushes_out_from_its_farther_half",
    "JointsWithoutLimits": "test_jointed_bodies_stay_within_their_limits",
    "BodiesFallInHoney": "test_a_free_body_falls_as_gravity_says",
    "ResetKeepsSpeed": "test_a_reset_stops_free_bodies",
    "RestoreForgetsSpeeds": "test_a_falling_body_keeps_falling_after_a_restore",
    "RestoreForgetsTime": "test_restore_returns_the_time",
    "ContactsOutliveAReset": (
        "test_what_happens_to_free_bodies_after_a_reset_depends_on_the_state_alone"
    ),
    "AnyScene": "test_a_state_of_another_scene_is_refused_and_changes_nothing",
    "SilentThoughItHasAReason": "test_a_backend_takes_images_or_says_why_not",
    "ForgetsWhatItHolds": "test_the_bodies_observed_are_those_that_a_backend_knows",
    "ImagesStretched": "test_bodies_appear_as_the_field_of_view_has_them",
    "DrawsItsOwnCamera": "test_a_drawing_camera_need_not_be_one_of_the_scene_s",
}


def _params(faults: dict[str, str], *marks: pytest.MarkDecorator) -> list[object]:
    return [pytest.param(name, test, marks=marks, id=name) for name, test in faults.items()]


@pytest.fixture(scope="module")
def outcomes(request, run_suite):
    """What the suite says of all faults that are to be tested, in one run."""
    asked = {
        item.callspec.params["fault"]
        for item in request.session.items
        if item.path == request.path and "fault" in getattr(item, "fixturenames", ())
    }
    return run_suite([f"faults:{name}" for name in sorted(asked)], ROBOT)


@pytest.mark.parametrize(
    ("fault", "test"), [*_params(FAULTS), *_params(MORE_FAULTS, pytest.mark.slow)]
)
def test_a_fault_fails_the_one_test_that_names_it(outcomes, fault, test):
    assert set(outcomes[f"faults:{fault}"].failed) == {test}


def test_every_broken_backend_is_tested():
    tree = ast.parse(Path(__file__).with_name("faults.py").read_text())
    classes = {node.name for node in tree.body if isinstance(node, ast.ClassDef)}
    public = {name for name in classes if not name.startswith("_")}
    assert public == {*FAULTS, *MORE_FAULTS}
