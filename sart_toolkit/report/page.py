"""`report.html`: one self-contained page that shows what a run taught the robot and how well."""

from __future__ import annotations

import base64
import collections
import html
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from sart_toolkit.data.dataset import load_dataset
from sart_toolkit.data.records import Annotation, Demonstration
from sart_toolkit.data.storage import (
    load_annotation,
    load_demonstration,
    read_json,
    write_text,
)
from sart_toolkit.errors import BrokenFile, MissingFile, SartError
from sart_toolkit.report.figures import (
    SegmentPath,
    Theme,
    film_strip,
    placement_picture,
    scene_picture,
    segment_paths,
    sphere_colour,
    training_curve,
)

MAX_VIDEO_BYTES = 48 * 2**20
_FILM_PICTURES = 8


def write_report(run_dir: Path, out: Path) -> None:
    """Write the page about a run to `out`: pictures and videos inside, no request to anywhere.

    A part that the run doesn't have yet is left out with a line that says so; a part that is
    there but damaged is an error.

    Args:
        run_dir: what `sart run` writes: `demo.h5`, `annotation.json`, `dataset/`, `skill/`,
            `evaluation.json`, `videos/`, `run.json`, any of them absent.
        out: the HTML file, written whole or not at all.

    Raises:
        MissingFile: `run_dir` isn't there or holds no part of a run.
        BrokenFile: a part is damaged or lacks a field.
        InvalidInput, Mismatch: a part holds a value that can't be, or belongs to another run.
        CannotWrite: the disk refuses.
    """
    write_text(Path(out), _page(_load_run(Path(run_dir))))


# --- what a run holds ---------------------------------------------------------------------------


@dataclass(frozen=True)
class _Run:
    """The parts of a run; `None` for those that aren't there."""

    directory: Path
    demonstration: Demonstration | None
    annotation: Annotation | None
    augmentation: Mapping[str, Any] | None
    paths: Sequence[SegmentPath]
    training: Mapping[str, Any] | None
    evaluation: Mapping[str, Any] | None
    run: Mapping[str, Any] | None


_Part = TypeVar("_Part")


def _load_run(directory: Path) -> _Run:
    def optional(name: str, load: Callable[[Path], _Part]) -> _Part | None:
        path = directory / name
        return load(path) if path.exists() else None

    if not directory.is_dir():
        raise MissingFile(f"{directory}: no such directory; pass one that `sart run` wrote")
    dataset = None
    if (directory / "dataset" / "dataset.json").exists():
        dataset = load_dataset(directory / "dataset")
    run = _Run(
        directory=directory,
        demonstration=optional("demo.h5", load_demonstration),
        annotation=optional("annotation.json", load_annotation),
        augmentation=dataset.info if dataset is not None else None,
        paths=segment_paths(dataset) if dataset is not None else (),
        training=optional("skill/training.json", read_json),
        evaluation=optional("evaluation.json", read_json),
        run=optional("run.json", read_json),
    )
    parts = (run.demonstration, run.annotation, dataset, run.training, run.evaluation, run.run)
    if all(part is None for part in parts):
        raise MissingFile(f"{directory}: holds no part of a run; pass one that `sart run` wrote")
    return run


def _field(value: Any, file: str, *keys: str) -> Any:
    """What lies under the keys of a file's JSON.

    Raises:
        BrokenFile: it isn't there.
    """
    for depth, key in enumerate(keys):
        if not isinstance(value, Mapping) or key not in value:
            raise BrokenFile(f"{file}: has no {'.'.join(keys[: depth + 1])}; make it again")
        value = value[key]
    return value


# --- HTML ---------------------------------------------------------------------------------------


class Markup(str):
    """Text that is HTML already; any other string is escaped when it becomes part of an element."""

    __slots__ = ()


def element(tag: str, /, *children: str, **attributes: str | int | bool) -> Markup:
    """One HTML element, its text and attribute values escaped.

    Args:
        tag: the element's name.
        children: text, escaped unless it is `Markup`.
        attributes: by name; a trailing underscore is dropped (`class_`), an inner one becomes a
            hyphen, `True` stands for an attribute without a value.
    """
    written = "".join(
        f" {name.rstrip('_').replace('_', '-')}"
        + ("" if value is True else f'="{html.escape(str(value))}"')
        for name, value in attributes.items()
        if value is not False
    )
    if tag in ("img", "source", "meta"):
        return Markup(f"<{tag}{written}>")
    return Markup(f"<{tag}{written}>{join(children)}</{tag}>")


def join(parts: Iterable[str]) -> Markup:
    """The parts one after the other, escaped unless they are `Markup`."""
    return Markup("".join(p if isinstance(p, Markup) else html.escape(p) for p in parts))


def _data_uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def _image(png: bytes, alt: str, dark: bytes | None = None) -> Markup:
    # A PNG's width and height are the first two numbers of its first chunk.
    width, height = (int.from_bytes(png[at : at + 4], "big") for at in (16, 20))
    image = element("img", src=_data_uri("image/png", png), alt=alt, width=width, height=height)
    if dark is None:
        return image
    on_dark = "screen and (prefers-color-scheme: dark)"
    source = element("source", media=on_dark, srcset=_data_uri("image/png", dark))
    return element("picture", source, image)


def _drawn(draw: Callable[[Theme], bytes], alt: str) -> Markup:
    return _image(draw("light"), alt, draw("dark"))


def _table(
    head: Sequence[str], rows: Iterable[Sequence[str]], numeric: Sequence[int] = ()
) -> Markup:
    def cells(tag: str, row: Sequence[str], **attributes: str) -> Markup:
        return element(
            "tr",
            *(
                element(tag, cell, class_="number" if i in numeric else "", **attributes)
                for i, cell in enumerate(row)
            ),
        )

    table = element(
        "table",
        element("thead", cells("th", head, scope="col")),
        element("tbody", *(cells("td", row) for row in rows)),
    )
    return _scrolling("scroll", f"table by {head[0]}", table)


def _scrolling(kind: str, label: str, content: Markup) -> Markup:
    """Content that scrolls sideways where the page is narrow, by keyboard as well."""
    return element("div", content, class_=kind, role="region", aria_label=label, tabindex=0)


def _section(title: str, *content: str) -> Markup:
    return element("section", element("h2", title), *content)


def _absent(title: str, why: str) -> Markup:
    return _section(title, element("p", why, class_="absent"))


def _bar(share: float, colour: str = "") -> Markup:
    """A bar that fills a share of its place; the number beside it says the same in words."""
    style = f"width:{100 * share:.2f}%" + (f";background:{colour}" if colour else "")
    fill = element("span", class_="fill", style=style)
    return element("span", fill, class_="bar", aria_hidden="true")


def _badge(outcome: str) -> Markup:
    known = outcome if outcome in ("success", "failure") else ""
    sign = {"success": "✓ ", "failure": "✗ "}.get(outcome, "")
    return element("span", sign, outcome, class_=f"badge {known}".strip())


# --- numbers in words ---------------------------------------------------------------------------


# No line may end between a number and its unit.
_SPACE = "\N{NO-BREAK SPACE}"


def duration(seconds: float) -> str:
    """A time span as a person would write it: `9.6 s`, `3 min 32 s`, `2 h 05 min`."""
    if seconds < 59.95:
        return f"{seconds:.1f}{_SPACE}s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes}{_SPACE}min {rest:02d}{_SPACE}s"
    return f"{minutes // 60}{_SPACE}h {minutes % 60:02d}{_SPACE}min"


def percent(share: float) -> str:
    """A share of 1 in per cent, to a tenth where it has one."""
    return f"{100 * share:.1f}".removesuffix(".0") + f"{_SPACE}%"


def _millimetres(metres: float) -> str:
    return f"{1e3 * metres:.1f}{_SPACE}mm"


def _plural(n: int, one: str, many: str = "") -> str:
    return f"{n} {one if n == 1 else many or one + 's'}"


def _flat(value: Any, prefix: str = "") -> Iterable[tuple[str, str]]:
    """Nested JSON as rows of dotted name and text."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _flat(inner, f"{prefix}.{key}" if prefix else str(key))
    else:
        yield prefix, "none" if value is None else str(value)


# --- the sections -------------------------------------------------------------------------------


def _names(run: _Run) -> dict[str, str]:
    """Task, robot, backend and policy, from whichever part knows them."""
    names: dict[str, str] = {}
    demonstration = run.demonstration
    if demonstration is not None:
        names = {
            "task": demonstration.task,
            "robot": demonstration.robot,
            "backend": demonstration.backend,
        }
    if run.evaluation is not None:
        for key in ("task", "robot", "backend", "policy"):
            names[key] = str(_field(run.evaluation, "evaluation.json", key))
    return names


def _tile(label: str, value: str, *notes: str) -> Markup:
    return element(
        "div",
        element("dt", label),
        element("dd", value, class_="value"),
        *(element("dd", note, class_="note") for note in notes),
        class_="tile",
    )


def _headline(run: _Run) -> Markup:
    tiles = []
    if run.evaluation is not None:
        n, k, low, high = _score(run.evaluation)
        tiles.append(
            _tile(
                "Success",
                f"{k} / {n}",
                f"{percent(k / n)}, Wilson 95 % interval {percent(low)} to {percent(high)}",
            )
        )
    if run.demonstration is not None:
        d = run.demonstration
        steps = f"{len(d)} steps over {duration(float(d.timestamps[-1] - d.timestamps[0]))}"
        tiles.append(_tile("Demonstrations", "1", steps))
        by_hand = run.annotation is not None and any(
            sphere.source == "human" for sphere in run.annotation.spheres
        )
        annotating = run.annotation.seconds if run.annotation is not None and by_hand else 0.0
        notes = [f"{duration(d.seconds)} demonstrating, by {d.operator}"]
        if by_hand:
            notes.append(f"{duration(annotating)} annotating")
        elif run.annotation is not None:
            notes.append("no annotating: radii suggested by the toolkit")
        tiles.append(_tile("Human time", duration(d.seconds + annotating), *notes))
    if run.augmentation is not None:
        file = "dataset.json"
        n_kept, tried = (int(_field(run.augmentation, file, k)) for k in ("n_kept", "n_attempted"))
        tiles.append(
            _tile("Generated by the robot", str(n_kept), f"trajectories, of {tried} attempted")
        )
    if run.run is not None:
        stages = _field(run.run, "run.json", "stages")
        tiles.append(
            _tile(
                "Wall clock",
                duration(sum(stages.values())),
                f"{_plural(len(stages), 'stage')}: {', '.join(stages)}",
            )
        )
    return element("dl", *tiles, class_="tiles")


def _score(evaluation: Mapping[str, Any]) -> tuple[int, int, float, float]:
    """Rollouts, successes, and the interval's ends."""
    file = "evaluation.json"
    n, k = (int(_field(evaluation, file, key)) for key in ("n_episodes", "n_success"))
    low, high = _field(evaluation, file, "ci95")
    if n < 1:
        raise BrokenFile(f"{file}: counts {n} episodes; evaluate at least one")
    return n, k, float(low), float(high)


def _demonstration_section(run: _Run) -> Markup:
    title = "The demonstration"
    if run.demonstration is None:
        return _absent(title, "No demo.h5 in this run: nothing was recorded yet.")
    d = run.demonstration
    if not d.steps.cameras:
        return _absent(title, "The demonstration holds no camera pictures.")
    camera = "wrist" if "wrist" in d.steps.cameras else sorted(d.steps.cameras)[0]
    n = min(_FILM_PICTURES, len(d))
    end = duration(float(d.timestamps[-1] - d.timestamps[0]))
    alt = f"{n} pictures of the {camera} camera, evenly from the start to the end after {end}"
    return _section(
        title,
        element(
            "p",
            f"What the {camera} camera saw, from the start to the end. These pictures and the "
            "gripper are all that the policy ever gets to see.",
        ),
        _scrolling("film", "film strip", _image(film_strip(d, camera, n), alt)),
    )


def _sphere_section(run: _Run) -> Markup:
    title = "Where precision matters"
    if run.demonstration is None or run.annotation is None:
        name = "demo.h5" if run.demonstration is None else "annotation.json"
        return _absent(title, f"No {name} in this run: there are no precision spheres to draw.")
    demonstration, annotation, paths = run.demonstration, run.annotation, run.paths
    annotation.check_matches(demonstration)

    def draw(theme: Theme) -> bytes:
        return scene_picture(demonstration, annotation, paths, theme)

    counts = collections.Counter(path.sphere for path in paths)
    rows = []
    for i, sphere in enumerate(annotation.spheres):
        at = demonstration.timestamps[sphere.waypoint] - demonstration.timestamps[0]
        swatch = element("span", class_="swatch", style=f"background:{sphere_colour(i)}")
        rows.append(
            [
                join([swatch, str(i)]),
                str(sphere.waypoint),
                f"{at:.1f} s",
                _millimetres(sphere.radius),
                "" if sphere.clearance is None else _millimetres(sphere.clearance),
                sphere.limited_by or "",
                sphere.source,
                str(counts[i]) if paths else "",
            ]
        )
    alt = (
        f"Two 3D views of the demonstrated tool path with {_plural(len(rows), 'precision sphere')}"
        + (f" and {_plural(len(paths), 'augmented path')} leading back to it" if paths else "")
    )
    head = (
        "sphere", "waypoint", "time", "radius", "clearance", "limited by", "source", "paths"
    )  # fmt: skip
    return _section(
        title,
        element(
            "p",
            "Around each key waypoint the tool may stray as far as its sphere reaches. From there "
            "the robot finds back to the demonstrated path: each coloured line is one such way, "
            "as measured while the robot moved.",
        ),
        _scrolling("drawing", "3D views", _drawn(draw, alt)),
        _table(head, rows, numeric=(1, 2, 3, 4, 7)),
    )


def _augmentation_section(run: _Run) -> Markup:
    title = "What the robot generated by itself"
    if run.augmentation is None:
        return _absent(title, "No finished dataset in this run: nothing was generated yet.")
    info, file = run.augmentation, "dataset.json"
    kept, attempted = (int(_field(info, file, key)) for key in ("n_kept", "n_attempted"))
    rejections: Mapping[str, int] = _field(info, file, "rejections")
    seconds = float(_field(info, file, "seconds"))
    rate = f", {kept / seconds:.1f} kept each second" if seconds > 0 else ""
    share = f" ({percent(kept / attempted)})" if attempted else ""
    clear = info.get("least_clearance_m")
    parts = [
        element(
            "p",
            element("strong", f"{kept} of {attempted}"),
            f" attempted trajectories were kept{share}, in {duration(seconds)}{rate}. Each was "
            "proved to stay clear before the robot moved, and again as it was measured"
            + (f": by at least {_millimetres(float(clear))}." if clear else "."),
        )
    ]
    total = max(attempted, 1)
    rows = [("kept", kept, "var(--good)")]
    rows += [(reason, count, "var(--bad)") for reason, count in rejections.items()]
    if rejections:
        parts.append(
            _table(
                ("outcome", "trajectories", "share"),
                [
                    (name, str(count), join([_bar(count / total, colour), percent(count / total)]))
                    for name, count, colour in rows
                ],
                numeric=(1,),
            )
        )
    return _section(title, *parts)


def _training_section(run: _Run) -> Markup:
    title = "Learning"
    if run.training is None:
        return _absent(title, "No skill/training.json in this run: no policy was trained yet.")
    file = "training.json"
    curve = _field(run.training, file, "curve")
    if not curve:
        raise BrokenFile(f"{file}: its curve has no epoch; train the skill again")
    epochs = [float(_field(row, file, "epoch")) for row in curve]
    losses = [float(_field(row, file, "loss")) for row in curve]
    seconds = sum(float(_field(row, file, "seconds")) for row in curve)
    pace = run.training.get("images_per_second")
    policy = (run.training.get("config") or {}).get("policy", "the policy")

    def draw(theme: Theme) -> bytes:
        return training_curve(epochs, losses, theme)

    epochs_words = _plural(len(curve), "epoch")
    alt = f"Training loss over {epochs_words}, on a logarithmic scale, ending at {losses[-1]:.2g}"
    return _section(
        title,
        element(
            "p",
            element("strong", str(policy)),
            f" was trained for {epochs_words} in {duration(seconds)}"
            + (f", {pace:,.0f} pictures each second." if pace else "."),
        ),
        _scrolling("drawing", "training curve", _drawn(draw, alt)),
    )


def _interval(label: str, k: int, n: int, low: float, high: float) -> Markup:
    words = f"{label}: {k} of {n}, {percent(k / n)}, interval {percent(low)} to {percent(high)}"
    return element(
        "div",
        element("span", label, class_="label"),
        element(
            "span",
            element(
                "span", class_="range", style=f"left:{100 * low:.2f}%;right:{100 - 100 * high:.2f}%"
            ),
            element("span", class_="point", style=f"left:{100 * k / n:.2f}%"),
            class_="track",
            role="img",
            aria_label=words,
        ),
        element("span", f"{percent(k / n)} ", element("small", f"{k}/{n}"), class_="amount"),
        class_="interval",
    )


def _success_section(run: _Run) -> Markup:
    title = "How well it works"
    if run.evaluation is None:
        return _absent(title, "No evaluation.json in this run: the skill was not evaluated yet.")
    evaluation, file = run.evaluation, "evaluation.json"
    n, k, low, high = _score(evaluation)
    bars = [_interval("at the end", k, n, low, high)]
    if "n_success_any" in evaluation:
        low_any, high_any = _field(evaluation, file, "ci95_any")
        bars.append(
            _interval("at any time", int(evaluation["n_success_any"]), n, low_any, high_any)
        )
    scale = element(
        "div",
        *(element("span", f"{share} %", style=f"left:{share}%") for share in (0, 25, 50, 75, 100)),
        class_="scale",
        aria_hidden="true",
    )
    parts = [
        element(
            "p",
            element("strong", f"{k} of {n} rollouts succeeded."),
            " Each had its object at a random place that was never seen in training. Dots are the "
            "measured success rates, bars their Wilson 95 % intervals.",
        ),
        element("div", *bars, scale, class_="intervals"),
    ]
    episodes = _field(evaluation, file, "episodes")
    reasons = collections.Counter(
        str(e.get("reason") or "no reason given") for e in episodes if e.get("outcome") == "failure"
    )
    places = _placements(run, episodes)
    beside = []
    if reasons:
        beside.append(element("h3", "Why rollouts failed"))
        counted = [(reason, str(count)) for reason, count in reasons.most_common()]
        beside.append(_table(("reason", "rollouts"), counted, numeric=(1,)))
    if places or beside:
        parts.append(
            element("div", *([places] if places else []), element("div", *beside), class_="columns")
        )
    return _section(title, *parts)


def _placements(run: _Run, episodes: Sequence[Mapping[str, Any]]) -> Markup | None:
    placed = [e for e in episodes if e.get("placement")]
    if not placed:
        return None
    places = [e["placement"] for e in placed]
    outcomes = [_field(e, "evaluation.json", "outcome") for e in placed]
    names = {name for place in places for name in place}
    # The demonstration's own placement has no name; it is clear only where there is one object.
    shown = run.demonstration.task_parameters.get("placement") if run.demonstration else None
    demonstrated = {names.pop(): shown} if shown and len(names) == 1 else None

    def draw(theme: Theme) -> bytes:
        return placement_picture(places, outcomes, demonstrated, theme)

    good = outcomes.count("success")
    bad = len(places) - good
    alt = f"Top view of {len(places)} object placements: {good} successes, {bad} failures"
    caption = "Where the object stood in each rollout, seen from above."
    return element("figure", _drawn(draw, alt), element("figcaption", caption), class_="square")


def _video_section(run: _Run) -> Markup:
    title = "Videos"
    if run.evaluation is None:
        return _absent(title, "No evaluation.json in this run: there are no rollouts to show.")
    rows = run.evaluation.get("videos") or []
    if not rows:
        return _absent(title, "The evaluation made no videos.")
    figures, left_out, room = [], [], MAX_VIDEO_BYTES
    for row in rows:
        name = str(_field(row, "evaluation.json", "path"))
        path = (run.directory / name).resolve()
        if not path.is_relative_to(run.directory.resolve()):
            raise BrokenFile(
                f"evaluation.json: video {name!r} lies outside the run; evaluate again"
            )
        if not path.is_file():
            left_out.append(f"{name} is not there")
            continue
        if path.stat().st_size > room:
            left_out.append(f"{name} is too large to be part of this page")
            continue
        content = path.read_bytes()
        room -= len(content)
        outcome, number = str(row.get("outcome", "")), row.get("episode", "?")
        video = element(
            "video",
            src=_data_uri("video/mp4", content),
            controls=True,
            loop=True,
            muted=True,
            playsinline=True,
            preload="metadata",
            aria_label=f"Video of episode {number}: {outcome}",
        )
        caption = element("figcaption", _badge(outcome), f" episode {number}")
        figures.append(element("figure", video, caption))
    notes = [element("p", f"Left out: {'; '.join(left_out)}.", class_="absent")] if left_out else []
    return _section(title, element("div", *figures, class_="videos"), *notes)


def _episode_section(run: _Run) -> Markup:
    title = "Every rollout"
    if run.evaluation is None:
        return _absent(title, "No evaluation.json in this run: there are no rollouts to list.")
    file = "evaluation.json"
    rows = []
    for e in _field(run.evaluation, file, "episodes"):
        seed = e.get("seed", "")
        rows.append(
            [
                str(_field(e, file, "episode")),
                f",{_SPACE}".join(map(str, seed)) if isinstance(seed, list) else str(seed),
                _placement_words(e.get("placement") or {}),
                _badge(str(_field(e, file, "outcome"))),
                "yes" if e.get("success_any") else "no",
                str(e.get("steps", "")),
                str(e.get("reason") or ""),
            ]
        )
    head = ("episode", "seed", "placement", "outcome", "success at any time", "steps", "reason")
    summary = element("summary", f"Table of {_plural(len(rows), 'episode')}")
    table = _table(head, rows, numeric=(0, 5))
    return _section(title, element("details", summary, table))


def _placement_words(placement: Mapping[str, Mapping[str, float]]) -> str:
    words = []
    for name, at in placement.items():
        x, y, yaw = (float(at.get(key, 0.0)) for key in ("x", "y", "yaw_deg"))
        turned = f", {yaw:+.0f}°" if yaw else ""
        words.append(f"{name} {1e3 * x:+.1f}, {1e3 * y:+.1f} mm{turned}")
    return "; ".join(words)


def _time_section(run: _Run) -> Markup:
    title = "Where the time went"
    if run.run is None:
        return _absent(title, "No run.json in this run: the stages were run one by one.")
    stages: Mapping[str, float] = _field(run.run, "run.json", "stages")
    total = sum(stages.values()) or 1.0
    rows: list[tuple[str, ...]] = [
        (name, duration(seconds), join([_bar(seconds / total), percent(seconds / total)]))
        for name, seconds in stages.items()
    ]
    machine = run.run.get("machine") or {}
    words = ", ".join(
        f"memory {value} GiB" if key == "memory_gib" else f"{key.replace('_', ' ')} {value}"
        for key, value in machine.items()
    )
    return _section(
        title,
        element(
            "p",
            element("strong", duration(sum(stages.values()))),
            " of wall-clock time in all" + (f" on this machine: {words}." if words else "."),
        ),
        _table(("stage", "time", "share"), rows, numeric=(1,)),
    )


def _detail_section(run: _Run) -> Markup:
    groups: list[tuple[str, Any]] = []
    if run.run is not None:
        groups.append(("Command", {"command": run.run.get("command", "")}))
        groups.append(("Run configuration", run.run.get("config") or {}))
    if run.augmentation is not None:
        groups.append(("Augmentation configuration", run.augmentation.get("config") or {}))
    if run.training is not None:
        groups.append(("Training configuration", run.training.get("config") or {}))
    if run.evaluation is not None:
        groups.append(("Evaluation configuration", run.evaluation.get("config") or {}))
    versions: dict[str, Any] = {}
    for part in (run.evaluation, run.run):
        versions |= (part or {}).get("versions") or {}
    groups.append(("Versions", versions))
    hashes: dict[str, Any] = {}
    if run.demonstration is not None:
        hashes["demonstration"] = run.demonstration.content_hash()
    if run.augmentation is not None:
        hashes["dataset"] = run.augmentation.get("content_hash")
    groups.append(("Content hashes (SHA-256)", hashes))
    folded = [
        element("details", element("summary", name), _table(("name", "value"), list(_flat(value))))
        for name, value in groups
        if value
    ]
    return _section("To make it again", *folded)


# --- the page -----------------------------------------------------------------------------------

_SECTIONS: tuple[Callable[[_Run], Markup], ...] = (
    _demonstration_section,
    _sphere_section,
    _augmentation_section,
    _training_section,
    _success_section,
    _video_section,
    _episode_section,
    _time_section,
    _detail_section,
)


def _page(run: _Run) -> str:
    names = _names(run)
    task = names.pop("task", run.directory.resolve().name)
    facts = [
        element("span", f"{key} ", element("b", value)) for key, value in names.items() if value
    ]
    try:
        body = [_headline(run), *(section(run) for section in _SECTIONS)]
    except SartError:
        raise
    except (TypeError, ValueError, AttributeError) as error:
        raise BrokenFile(
            f"{run.directory}: a JSON file of the run holds a value of the wrong type ({error}); "
            "make that part again"
        ) from error
    # Nothing but what the page carries may load, even if hostile text got into it.
    policy = "default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'"
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=policy),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("title", f"{task}: a skill from one demonstration"),
        element("style", Markup(_STYLE)),
    )
    header = element(
        "header",
        element("p", "A skill from one demonstration", class_="eyebrow"),
        element("h1", task),
        element("p", *facts, class_="facts"),
    )
    main = element("main", header, *body)
    footer = element("footer", "Made by sart_toolkit. This page needs no network.")
    page = element("html", head, element("body", main, footer), lang="en")
    return f"<!doctype html>\n{page}\n"


_STYLE = """
:root {
  color-scheme: light dark;
  --paper: #f5f6f8; --card: #ffffff; --ink: #1f2430; --soft: #5b6474; --line: #dfe3ea;
  --accent: #0063b1; --track: #e8ebf0; --good: #00795a; --bad: #b84a00; --badge: #ffffff;
}
@media screen and (prefers-color-scheme: dark) {
  :root {
    --paper: #12151a; --card: #1b1f27; --ink: #e7eaf0; --soft: #a2abba; --line: #323846;
    --accent: #6cb6ff; --track: #2a303b; --good: #3ecf9f; --bad: #ff9a57; --badge: #12151a;
  }
}
* { box-sizing: border-box; }
body {
  margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif;
  overflow-wrap: break-word;
}
main { max-width: 1080px; margin: 0 auto; padding: 2.2rem 1.2rem 1rem; }
footer { max-width: 1080px; margin: 0 auto; padding: 0 1.2rem 2rem; color: var(--soft);
  font-size: .85rem; }
h1 { font-size: clamp(1.7rem, 5vw, 2.5rem); line-height: 1.15; margin: 0 0 .4rem; }
h2 { font-size: 1.25rem; margin: 0 0 .5rem; }
h3 { font-size: 1rem; margin: .2rem 0 .5rem; }
p { margin: 0 0 .9rem; max-width: 70ch; }
.eyebrow { color: var(--accent); font-weight: 600; margin: 0 0 .2rem; }
.facts { display: flex; flex-wrap: wrap; gap: .2rem 1.4rem; color: var(--soft);
  margin-bottom: 1.2rem; }
.facts b { color: var(--ink); font-weight: 600; }
section, .tile { background: var(--card); border: 1px solid var(--line); border-radius: 10px; }
section { padding: 1.3rem 1.4rem; margin: 1rem 0; }
section > :last-child { margin-bottom: 0; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(185px, 1fr)); gap: .8rem;
  margin: 0; }
.tile { padding: .9rem 1.1rem; }
.tile dt { color: var(--soft); font-size: .85rem; }
.tile dd { margin: 0; }
.tile .value { font-size: 1.45rem; font-weight: 650; line-height: 1.3; }
.tile .note { color: var(--soft); font-size: .85rem; line-height: 1.4; }
.absent { color: var(--soft); font-style: italic; }
figure { margin: 0 0 1rem; }
figcaption { color: var(--soft); font-size: .9rem; margin-top: .3rem; }
img { display: block; max-width: 100%; height: auto; margin: 0 auto; }
.film, .drawing { overflow-x: auto; }
.film { border-radius: 6px; background: #15181d; }
.film img { width: 100%; min-width: 820px; }
.drawing img { min-width: 540px; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .92rem;
  font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: .38rem .9rem .38rem 0; border-bottom: 1px solid var(--line);
  vertical-align: top; }
td:last-child { overflow-wrap: anywhere; min-width: 3.2rem; }
th { color: var(--soft); font-weight: 600; }
tbody tr:last-child td { border-bottom: 0; }
.number { text-align: right; white-space: nowrap; }
.number:not(:last-child) { padding-right: 1.7rem; }
.swatch { display: inline-block; width: .8em; height: .8em; border-radius: 50%;
  margin-right: .5em; }
.bar { display: inline-block; width: clamp(60px, 24vw, 300px); height: .7em; border-radius: 4px;
  background: var(--track); margin-right: .7em; overflow: hidden; }
.fill { display: block; height: 100%; min-width: 2px; background: var(--accent); }
.intervals { max-width: 760px; margin: 1.2rem 0; }
.interval, .scale { display: grid; grid-template-columns: 6.2rem 1fr 7rem; gap: .9rem; }
.interval { align-items: center; margin-bottom: .6rem; }
.track { position: relative; height: 14px; border-radius: 7px; background: var(--track); }
.range { position: absolute; top: 0; bottom: 0; border-radius: 7px; background: var(--accent);
  opacity: .45; }
.point { position: absolute; top: -3px; width: 20px; height: 20px; margin-left: -10px;
  border-radius: 50%; background: var(--accent); border: 3px solid var(--card); }
.amount { font-weight: 650; white-space: nowrap; }
.amount small, .label { color: var(--soft); font-weight: 400; }
.scale { position: relative; display: block; height: 1.3rem; margin: 0 7.9rem 0 7.1rem;
  font-size: .8rem; color: var(--soft); }
.scale span { position: absolute; transform: translateX(-50%); white-space: nowrap; }
.columns { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 330px), 1fr));
  gap: 1rem 2rem; align-items: start; }
.columns > div:empty { display: none; }
.square img { max-width: min(100%, 480px); margin: 0; }
.videos { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 300px), 1fr));
  gap: 1rem; }
.videos figure { margin: 0; }
video { display: block; width: 100%; height: auto; border-radius: 6px; background: #15181d; }
.badge { display: inline-block; padding: 0 .55em; border-radius: 4px; font-size: .85rem;
  white-space: nowrap; color: var(--badge); background: var(--soft); }
.badge.success { background: var(--good); }
.badge.failure { background: var(--bad); }
details { border-top: 1px solid var(--line); padding: .5rem 0; }
details:first-of-type { border-top: 0; }
summary { cursor: pointer; font-weight: 600; }
details[open] summary { margin-bottom: .5rem; }
:focus-visible { outline: 2px solid var(--accent); outline-offset: 2px; }
@media (max-width: 560px) {
  main { padding: 1.3rem .8rem 1rem; }
  section { padding: 1rem; }
  .interval { grid-template-columns: 1fr auto; gap: .2rem .8rem; }
  .interval .track { grid-column: 1 / -1; grid-row: 2; }
  .scale { margin: 0; }
  .scale span:first-child { transform: none; }
  .scale span:last-child { transform: translateX(-100%); }
}
@media print {
  :root { --paper: #ffffff; font-size: 11px; }
  body { font-size: 1rem; -webkit-print-color-adjust: exact; print-color-adjust: exact; }
  main { max-width: none; padding: 0; }
  section, .tile, figure, tr { break-inside: avoid; }
  section:has(details) { break-inside: auto; }
  .scroll, .film, .drawing { overflow: visible; }
  .film img, .drawing img { min-width: 0; }
  details::details-content { content-visibility: visible; block-size: auto; }
}
"""
