"""Act with a policy that `ucfrec-control train` made: any loop of observations and rewards."""

import gymnasium

from ucfrec_control import ControlPolicy

policy = ControlPolicy.load("run")  # target=… asks for another return
env = gymnasium.make("Pendulum-v1")
observation, _ = env.reset(seed=0)
policy.reset()
reward, total, ended = None, 0.0, False
while not ended:
    action = policy.act(observation, reward)
    observation, reward, terminated, truncated, _ = env.step(action)
    total, ended = total + float(reward), terminated or truncated
print(f"return {total:.1f}")
