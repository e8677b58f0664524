"""Stable-Baselines3 trains on the environment as it is."""

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")

from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env

from countersteer.envs.single import DriftEnv

pytestmark = pytest.mark.filterwarnings("ignore")  # theirs


def test_stable_baselines_trains_on_the_environment_unmodified():
    env = DriftEnv("box", longest=4.0)
    check_env(env)
    model = PPO("MlpPolicy", env, n_steps=256, batch_size=64, seed=0, device="cpu")
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.learn(768)
    after = model.policy.state_dict()
    assert model.num_timesteps == 768
    assert all(bool(value.isfinite().all()) for value in after.values())
    assert any(bool((after[name] != value).any()) for name, value in before.items())
    assert len(model.ep_info_buffer) > 0  # whole episodes were seen
    seen, _ = env.reset(seed=1)
    action, _ = model.predict(seen, deterministic=True)
    assert action.shape == (2,)
    assert np.all(np.abs(action) <= 1)
    env.close()
