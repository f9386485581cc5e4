# lare: task: HalfCheetah-v4
# lare: kind: factors
# lare: model: Claude (Anthropic), recorded 2026-11-20, draw 0
# lare: sha256: a5585e6c8094fcca91ebcf312d57b085c21f5b4372fb45cb8c39d60045c3335c
# lare: passed: read, finite
import numpy as np

def evaluation_func(observation, action):
    pitch = observation[:, 1:2]
    vx = observation[:, 8:9]
    vz = observation[:, 9:10]
    pitch_rate = observation[:, 10:11]

    # 1. forward speed
    f_forward = vx

    # 2. control cost
    f_control = -np.sum(np.square(action), axis=1, keepdims=True)

    # 3. level body: 0 when level, -2 when upside down
    f_posture = np.cos(pitch) - 1.0

    # 4. little pitching
    f_pitch_rate = -0.1 * np.square(pitch_rate)

    # 5. little bouncing
    f_bounce = -np.square(vz)

    return [f_forward, f_control, f_posture, f_pitch_rate, f_bounce]
