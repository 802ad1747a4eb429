"""`sart play`: which recording a path names, and window, page or video."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sart_toolkit import pipeline
from sart_toolkit.cli.arguments import Play
from sart_toolkit.cli.console import ProgressDisplay, say
from sart_toolkit.cli.web import check_web
from sart_toolkit.data.records import Demonstration
from sart_toolkit.data.storage import (
    OutputLock,
    check_writable,
    load_demonstration,
    load_recording,
)
from sart_toolkit.errors import BrokenFile, InvalidInput, Mismatch, MissingFile, unknown_name
from sart_toolkit.poses import check_positive

if TYPE_CHECKING:
    from sart_toolkit.report.player import Playback, SceneView

# The camera of the scene whose view is drawn if no other is asked for.
_OUTSIDE = "overview"


def play_verb(args: Play) -> dict[str, Any]:
    """`sart play`."""
    pipeline.check_names(task=args.task, robot=args.robot, backend=args.backend)
    check_play_options(args)
    playback = load_playback(args.file)
    demonstration = playback.demonstration
    if args.web:
        return _web_mode(args, playback)
    camera = args.camera or _OUTSIDE
    if camera in demonstration.steps.cameras:
        playback.camera = camera
        return play(args, playback, None)
    from sart_toolkit.report.player import SceneView

    size = pipeline.image_size_of(demonstration)
    make = pipeline.backend_maker(
        demonstration, size, demonstration.rates, args.task, args.robot, args.backend
    )
    with closing(make()) as backend:
        return play(args, playback, SceneView(playback, backend, camera))


def load_playback(path: Path) -> Playback:
    """The demonstration in a file, or the episode with the demonstration of its dataset.

    Raises:
        MissingFile: no such file, or the episode is outside its dataset.
        BrokenFile: something else than a recording.
        Mismatch: the dataset's demonstration isn't the episode's.
    """
    if path.is_dir():
        raise BrokenFile(f"{path}: is a directory; {_inside(path)}")
    if path.suffix == ".json":
        raise BrokenFile(f"{path}: holds no recording; pass a demonstration's or an episode's .h5")
    recording = load_recording(path)
    from sart_toolkit.report.player import Playback

    if isinstance(recording, Demonstration):
        return Playback(path.name, recording)
    at = path.resolve().parent
    beside = at.parent.parent / "sources" / at.name / "demo.h5"
    if not beside.exists():
        raise MissingFile(
            f"{path}: an episode needs the demonstration it was made from, {beside} isn't there; "
            "play it inside its dataset directory"
        )
    demonstration = load_demonstration(beside)
    if demonstration.content_hash() != recording.provenance.demonstration_hash:
        raise Mismatch(f"{path}: was made from another demonstration than {beside}; put it back")
    return Playback(path.name, demonstration, recording)


def _inside(path: Path) -> str:
    episodes = sorted(path.glob("episodes/*/*.h5"))
    if episodes:
        return f"name one of its {len(episodes)} episodes, such as {episodes[0]}"
    if (path / "demo.h5").exists():
        return f"its demonstration is {path / 'demo.h5'}"
    return "expected a demonstration's or an episode's .h5"


def check_play_options(args: Play) -> None:
    """Refuse what can't be done before anything is drawn.

    Raises:
        InvalidInput: the speed is not positive, the video's name doesn't end in .mp4, or an option
            is about something else than what is asked for.
        OutputExists, CannotWrite: the video can't be written.
        MissingExtra: a page is asked for, and viser isn't installed.
    """
    check_web(args, "--out" if args.out else "--backend" if args.backend else "")
    check_positive("speed", args.speed)
    if args.out is not None:
        if args.out.suffix.lower() != ".mp4":
            raise InvalidInput(f"{args.out}: expected a file name that ends in .mp4")
        check_writable(args.out, args.overwrite)


def _web_mode(args: Play, playback: Playback) -> dict[str, Any]:
    """What was played on a page until it was closed."""
    demonstration = playback.demonstration
    if args.camera is not None:
        # The view from outside can be turned: no camera of the scene is needed.
        if args.camera not in demonstration.steps.cameras:
            raise unknown_name("recorded camera", args.camera, demonstration.steps.cameras)
        playback.camera = args.camera
    from sart_toolkit.report.webplayer import play_in_browser

    robot, scene = pipeline.setting_of(demonstration, args.task, args.robot)
    known = all(body.name in demonstration.body_Ts_world for body in scene.bodies)
    world = pipeline.world_of(demonstration, task=args.task, robot=args.robot) if known else None
    play_in_browser(playback, robot, scene, world, args.speed, args.host, args.port, say)
    return _played(args, playback)


def _played(args: Play, playback: Playback) -> dict[str, Any]:
    return {
        "played": str(args.file),
        "kind": "episode" if playback.split else "demonstration",
        "task": playback.demonstration.task,
        "steps": len(playback),
        "seconds": playback.seconds,
    }


def play(args: Play, playback: Playback, scene: SceneView | None) -> dict[str, Any]:
    """What was played: in a window until it was closed, or into a video."""
    said = _played(args, playback)
    if args.out is None:
        from sart_toolkit.record.screen import Screen
        from sart_toolkit.report.player import PlayWindow

        with Screen(f"sart play {playback.title}") as screen:
            PlayWindow(playback, scene, screen, args.speed).run()
        return said
    from sart_toolkit.report.player import film
    from sart_toolkit.report.video import write_video

    with OutputLock(args.out), ProgressDisplay() as progress:
        check_writable(args.out, args.overwrite)

        def counted() -> Any:
            for i, frame in enumerate(film(playback, scene), 1):
                yield frame
                progress("play", i, len(playback))

        write_video(args.out, counted(), playback.hz * args.speed)
    return said | {"video": str(args.out)}
