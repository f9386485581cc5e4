# Written by hand by the engineers of this task, who know its score. Not the reply of a language model to the texts alone.
import numpy as np


def evaluation_func(observation, action):
    stage, leaves = 2 * observation[:, 1:2], 6 * observation[:, 2:3]
    leaf_nitrogen, soil_nitrogen = 6 * observation[:, 3:4], 20 * observation[:, 5:6]
    light = 20 * observation[:, 8:9]
    spread = np.where(action[:, 0:1] >= 0.05, action[:, 0:1], 0.0)
    grain_fills = np.where(stage > 1.0, 1.0, 0.0)
    # 1. light that the leaves catch while the grain fills
    f_grain_growth = grain_fills * light * (1 - np.exp(-0.6 * leaves)) / 10
    # 2. light that the leaves catch before
    f_early_growth = (1 - grain_fills) * light * (1 - np.exp(-0.6 * leaves)) / 10
    # 3. nitrogen in each m² of leaf, up to what a leaf needs
    f_leaf_nitrogen = np.minimum(leaf_nitrogen / np.maximum(leaves, 0.1), 1.5)
    # 4. fertiliser that is paid for
    f_fertiliser = -spread
    # 5. a pass of the spreader
    f_pass = -np.where(spread > 0, 1.0, 0.0)
    # 6. fertiliser that comes too late to be taken up
    f_late = -spread * grain_fills
    # 7. nitrogen that stays in the soil after flowering
    f_unused = -grain_fills * soil_nitrogen / 10
    return [f_grain_growth, f_early_growth, f_leaf_nitrogen, f_fertiliser, f_pass, f_late, f_unused]
