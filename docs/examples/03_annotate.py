"""Set a precision sphere by hand, see what is proved of it, and generate trajectories.

Run: python docs/examples/03_annotate.py OUT_DIR [N_TRAJECTORIES]
"""

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import sart_toolkit as sart


def main(out: Path, n: int = 20) -> None:
    demo = sart.load_demonstration(sart.asset("peg_in_hole/demo.h5"))
    task, robot = sart.get_task(demo.task), sart.get_robot(demo.robot)
    make_backend = partial(sart.make_backend, demo.backend, robot, task.scene)
    config = sart.AugmentConfig(n=n)

    # What the toolkit suggests, and one sphere three times as large: a person's mistake.
    suggested = sart.suggest_annotation(demo, sart.ExactWorld(demo, robot, task.scene))
    first, second, *others = suggested.spheres
    wide = replace(second, radius=3 * second.radius, source="human")
    mine = sart.Annotation((first, wide, *others), demo.content_hash())

    # Planned and proved, nothing executed.
    error = sart.get_backend(demo.backend).tracking_error
    for name, annotation in (("suggested", suggested), ("mine", mine)):
        sources = [(demo, annotation)]
        file = out / f"{name}.jsonl"
        plan = sart.preview_sources(sources, robot, task.scene, error, file, config)
        print(f"{name}: {plan.proved} of {plan.attempted} proved; {dict(plan.rejections)}")

    sart.save_annotation(out / "annotation.json", suggested)
    dataset = sart.augment_demonstration(
        demo, suggested, make_backend, out / "dataset", config, task=task
    )
    print(f"kept {len(dataset)} of {dataset.info['n_attempted']} segments")


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(int, sys.argv[2:]))
