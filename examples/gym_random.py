"""Parks at random: how to use the Gymnasium environment. Needs `pip install '.[gym]'`."""

from mapweave.extras import exit_without

exit_without("sim", "gym")
import gymnasium

env = gymnasium.make("mapweave.sim.gym:mapweave/Park-v0", seconds=10.0)
for seed in range(3):
    observation, info = env.reset(seed=seed)
    env.action_space.seed(seed)
    total, over = 0.0, False
    while not over:
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        total, over = total + float(reward), terminated or truncated
    off = info["distance"]
    print(f"seed {seed}: return {total:.2f}, parked {info['success']}, {off:.2f} m from the goal")
env.close()
