# lare: task: Wheat
# lare: kind: factors
# lare: model: Claude (Anthropic), recorded 2026-11-28, draw 1
# lare: sha256: e795a17ac0a7b1a0dbe9f3ca696577833fbe5f39dcb18cd8792d9592324939f5
# lare: passed: read, finite
import numpy as np

def evaluation_func(observation, action):
    obs = np.asarray(observation, dtype=float)
    act = np.asarray(action, dtype=float)

    # observation entries in physical units
    stage = obs[:, 1:2]                              # 0.5 = flowering, 1 = ripe
    lai = np.maximum(obs[:, 2:3], 0.0) * 6.0         # m2/m2
    leaf_n = np.maximum(obs[:, 3:4], 0.0) * 6.0      # g/m2
    stem_n = np.maximum(obs[:, 4:5], 0.0) * 3.0      # g/m2
    soil_n = np.maximum(obs[:, 5:6], 0.0) * 20.0     # g/m2
    total = np.maximum(obs[:, 6:7], 0.0) * 300.0     # kg/ha, this week's dose included
    radiation = np.maximum(obs[:, 8:9], 0.0)         # share of 20 MJ/m2/day

    # what is really spread, as a share of 60 kg/ha
    a = np.clip(act[:, 0:1], 0.0, 1.0)
    drives = (a >= 0.05).astype(float)
    dose = a * drives

    # phase: 0 before flowering, 1 after it, smooth in between
    after = np.clip((stage - 0.45) / 0.1, 0.0, 1.0)
    before = 1.0 - after

    # growth of the week: light, interception, nitrogen status of the leaves
    intercepted = 1.0 - np.exp(-0.6 * lai)
    n_per_leaf_area = leaf_n / np.maximum(lai, 0.05)  # g per m2 of leaf
    n_status = 1.0 - np.exp(-np.maximum(n_per_leaf_area - 0.2, 0.0) / 0.5)
    growth = radiation * intercepted * n_status

    # nitrogen in the living crop, with a diminishing return
    store = 1.0 - np.exp(-(leaf_n + stem_n) / 5.0)

    # 1: cost of the fertiliser
    fertiliser_cost = -dose

    # 2: cost of the pass of the spreader
    pass_cost = -drives

    # 3: growth before flowering, which builds canopy and reserves
    vegetative_growth = before * growth

    # 4: growth after flowering, which fills the grain
    grain_filling = after * growth

    # 5: nitrogen reserve of the crop from about flowering on, fading towards ripeness
    rise = np.clip((stage - 0.40) / 0.10, 0.0, 1.0)
    fall = np.clip((0.70 - stage) / 0.20, 0.0, 1.0)
    nitrogen_reserve = np.minimum(rise, fall) * store

    # 6: empty soil before flowering while the canopy still needs nitrogen
    soil_shortage = -before * intercepted * np.exp(-soil_n / 2.0) * (1.0 - store)

    # 7: leaves poor in nitrogen before flowering
    leaf_shortage = -before * intercepted * (1.0 - n_status)

    # 8: dose too late to be taken up
    late = np.clip((stage - 0.42) / 0.10, 0.0, 1.0)
    late_spreading = -dose * late

    # 9: dose on a soil that was already rich (60 kg/ha = 6 g/m2)
    soil_before = np.maximum(soil_n - 6.0 * dose, 0.0)
    rich = np.clip((soil_before - 3.0) / 6.0, 0.0, 1.0)
    rich_soil_spreading = -dose * rich

    # 10: mineral nitrogen left unused after flowering
    unused_soil_n = -after * np.clip(soil_n / 20.0, 0.0, 1.0)

    # 11: dose given when the season's total is already large
    oversupply = -dose * np.clip((total - 150.0) / 100.0, 0.0, 1.0)

    return [fertiliser_cost, pass_cost, vegetative_growth, grain_filling,
            nitrogen_reserve, soil_shortage, leaf_shortage, late_spreading,
            rich_soil_spreading, unused_soil_n, oversupply]
