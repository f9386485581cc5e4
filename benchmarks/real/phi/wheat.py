# lare: task: Wheat
# lare: kind: factors
# lare: model: Claude (Anthropic), recorded 2026-11-28, draw 0
# lare: sha256: 12957ac3a2309c73e77e0e0260fad7e79d0a6ec5d2c5e6a302a36698d8505ac3
# lare: passed: read, finite
def evaluation_func(observation, action):
    import numpy as np

    obs = np.asarray(observation, dtype=float)
    act = np.asarray(action, dtype=float)

    # State in physical units, each of shape (batch_size, 1)
    stage = np.clip(obs[:, 1:2], 0.0, 1.0)               # 0 emergence, 0.5 flowering, 1 ripe
    lai = np.maximum(obs[:, 2:3], 0.0) * 6.0             # m2 leaf / m2 ground
    leaf_n = np.maximum(obs[:, 3:4], 0.0) * 6.0          # g/m2
    stem_n = np.maximum(obs[:, 4:5], 0.0) * 3.0          # g/m2
    soil_n = np.maximum(obs[:, 5:6], 0.0) * 20.0         # g/m2
    total_spread = np.maximum(obs[:, 6:7], 0.0) * 300.0  # kg/ha
    light = np.maximum(obs[:, 8:9], 0.0)                 # share of 20 MJ/m2

    # What is really spread: nothing below 0.05
    share = np.clip(act[:, 0:1], 0.0, 1.0)
    drives = (share >= 0.05).astype(float)
    dose = share * drives                                # share of 60 kg/ha
    dose_n = 6.0 * dose                                  # g/m2

    # Phases: grain filling starts at flowering, uptake fades out towards it
    after = np.clip((stage - 0.47) / 0.06, 0.0, 1.0)
    before = 1.0 - after
    uptake_phase = np.clip((0.5 - stage) / 0.1, 0.0, 1.0)
    # Window around flowering, wider on the side of the grain filling
    distance = stage - 0.5
    width = np.where(distance < 0.0, 0.06, 0.12)
    near_flowering = np.exp(-0.5 * (distance / width) ** 2)

    # Light interception and nitrogen status of the leaves
    cover = 1.0 - np.exp(-0.6 * lai)
    n_per_leaf = leaf_n / np.maximum(lai, 0.05)          # g N / m2 leaf
    required = np.interp(stage, [0.0, 0.5, 1.0], [1.5, 0.8, 0.5])
    n_status = np.clip((n_per_leaf - 0.2) / (required - 0.2), 0.0, 1.0)
    growth = light * cover * (0.3 + 0.7 * n_status)

    # Nitrogen held by the crop, and what it can still take up
    crop_n = leaf_n + stem_n
    store = 1.0 - np.exp(-crop_n / 5.0)
    demand_left = uptake_phase * np.maximum(12.0 - crop_n, 0.0)

    # 1: growth before flowering (canopy and reserves)
    vegetative_growth = before * growth

    # 2: growth after flowering (fills the grain)
    grain_filling = after * growth

    # 3: closed canopy around flowering
    canopy_at_flowering = near_flowering * cover

    # 4: nitrogen taken up before flowering
    nitrogen_uptake = before * store

    # 5: nitrogen store around and soon after flowering
    nitrogen_store = near_flowering * store

    # 6: nitrogen available in the soil during the uptake phase, saturating
    supply = uptake_phase * (1.0 - np.exp(-(soil_n + dose_n) / 2.0))

    # 7: part of the dose that covers a real gap
    gap = np.maximum(demand_left - soil_n, 0.0)
    useful_dose = np.minimum(dose_n, gap) / 6.0

    # 8: leaves short of nitrogen before flowering
    nitrogen_shortage = -before * (1.0 - n_status)

    # 9: cost of the fertiliser
    fertiliser_cost = -dose

    # 10: cost of the pass of the spreader
    pass_cost = -drives

    # 11: dose near or after the end of the uptake
    late = np.clip((stage - 0.36) / 0.14, 0.0, 1.0)
    late_dose = -dose * late

    # 12: dose on a rich soil or after a high total of the season
    rich = np.clip((soil_n - 6.0) / 8.0, 0.0, 1.0)
    much = np.clip((total_spread - 150.0) / 100.0, 0.0, 1.0)
    redundant_dose = -dose * (1.0 - (1.0 - rich) * (1.0 - much))

    # 13: mineral nitrogen beyond what the crop can still take up
    surplus = -np.maximum(soil_n + dose_n - demand_left, 0.0) / 20.0

    return [vegetative_growth, grain_filling, canopy_at_flowering,
            nitrogen_uptake, nitrogen_store, supply, useful_dose,
            nitrogen_shortage, fertiliser_cost, pass_cost, late_dose,
            redundant_dose, surplus]
