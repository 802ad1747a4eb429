"""Count a trained skill's successes in its task's Gymnasium environment.

Run: python docs/examples/08_gymnasium.py SKILL_DIR [EPISODES]
"""

import sys
from pathlib import Path

import gymnasium

import sart_toolkit as sart
from sart_toolkit import gym


def main(directory: Path, episodes: int) -> None:
    skill = sart.load_skill(directory)
    env = gymnasium.make(gym.env_id(skill.config.task), backend=skill.config.backend)
    successes = 0
    for episode in range(episodes):
        observation, info = env.reset(seed=episode)
        skill.reset()
        ended = False
        while not ended:
            observation, _, terminated, truncated, info = env.step(skill(observation))
            ended = terminated or truncated
        successes += info["is_success"]
        print(f"episode {episode}: {info.get('reason', 'succeeded')}")
    env.close()
    print(f"{successes} of {episodes} succeeded")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 10)
