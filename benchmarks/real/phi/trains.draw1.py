# lare: task: Trains
# lare: kind: factors
# lare: model: Claude (Anthropic), recorded 2026-11-28, draw 1
# lare: sha256: 87f3ac03ab39a3797066506e6ec918d5d2eed73513dc7818d68baa9fc0b3d9ba
# lare: passed: read, finite
import numpy as np

def evaluation_func(observation, action):
    obs = np.nan_to_num(np.asarray(observation, dtype=np.float64), nan=0.0, posinf=10.0, neginf=-10.0)
    act = np.nan_to_num(np.asarray(action, dtype=np.float64), nan=0.0, posinf=1.0, neginf=0.0)

    # State of the train
    arrived = (obs[:, 3:4] > 0.5).astype(np.float64)
    active = 1.0 - arrived
    waiting = (obs[:, 0:1] > 0.5).astype(np.float64) * active
    moving = (obs[:, 1:2] > 0.5).astype(np.float64) * active
    standing = (obs[:, 2:3] > 0.5).astype(np.float64) * (1.0 - moving) * active
    on_map = np.clip(moving + standing, 0.0, 1.0)

    time_left = obs[:, 4:5]
    slack = obs[:, 5:6]
    may_depart = (obs[:, 6:7] <= 1e-6).astype(np.float64)
    distance = np.clip(obs[:, 7:8], 0.0, 3.0)
    stop = (act[:, 3:4] > 0.5).astype(np.float64)

    # The three branches, one column each: left, ahead, right
    exists = obs[:, [8, 13, 18]] > 0.5
    detour = np.clip(obs[:, [9, 14, 19]], 0.0, 2.0)
    # 1 for a train in the next cell, 0 for none
    close = np.clip(2.0 * obs[:, [10, 15, 20]], 0.0, 1.0)
    oncoming = (obs[:, [11, 16, 21]] > 1e-6).astype(np.float64)
    same_way = (obs[:, [12, 17, 22]] > 1e-6).astype(np.float64)
    count = np.sum(exists, axis=1, keepdims=True)
    has_branch = (count > 0).astype(np.float64)
    at_switch = (count > 1).astype(np.float64)

    # An oncoming train before the next switch is dangerous at any distance, more so when near
    head_on = oncoming * (0.5 + 0.5 * close)
    # A near predicted conflict that is neither an oncoming train nor one that runs ahead
    conflict = (1.0 - oncoming) * (1.0 - same_way) * close

    # The best existing branch: least danger plus detour
    cost = np.where(exists, 2.0 * head_on + 0.6 * conflict + detour, 1000.0)
    best = np.argmin(cost, axis=1)[:, None]
    best_head_on = np.take_along_axis(head_on, best, axis=1) * has_branch
    best_conflict = np.take_along_axis(conflict, best, axis=1) * has_branch
    best_detour = np.take_along_axis(detour, best, axis=1) * has_branch
    best_close = np.take_along_axis(close, best, axis=1) * has_branch
    way_cost = np.clip(best_head_on + 0.3 * best_conflict + 0.3 * best_detour, 0.0, 1.0)

    # How free the freest branch is: no oncoming train, nothing near, no big detour
    obstruction = np.clip(np.maximum(head_on, close) + 0.4 * detour, 0.0, 1.0)
    free_way = 1.0 - np.min(np.where(exists, obstruction, 1.0), axis=1, keepdims=True)

    # Face to face with an oncoming train on every existing branch
    facing = np.min(np.where(exists, oncoming * close, 1.0), axis=1, keepdims=True) * has_branch

    # 1. The goal: the train has arrived
    factor_arrived = arrived

    # 2. Remaining distance to the target until arrival
    factor_distance = -distance * active

    # 3. It will be late
    late = 0.5 * (slack < -1e-6).astype(np.float64) + 0.5 * np.clip(-slack, 0.0, 1.0)
    factor_late = -late * active

    # 4. Arrival before the end of the episode is no longer possible
    lacking = distance - time_left
    hopeless = 0.5 * (lacking > 1e-6).astype(np.float64) + 0.5 * np.clip(lacking, 0.0, 1.0)
    factor_hopeless = -hopeless * active

    # 5. Flow: moves with a good way on
    factor_flow = moving * (1.0 - way_cost)

    # 6. On the map with oncoming trains on even the best branch
    factor_head_on = -on_map * best_head_on

    # 7. Deadlock: stands face to face with an oncoming train on every branch
    factor_deadlock = -standing * facing

    # 8. Stands on the map: costs time and holds up the trains behind
    factor_standing = -standing

    # 9. Chose to stop on the map although a branch is free
    factor_needless_stop = -standing * stop * free_way

    # 10. Still waits outside after its earliest departure although the way is free
    factor_idle_outside = -waiting * may_depart * free_way * (0.3 + 0.7 * stop)

    # 11. Holds back outside the map, or at a switch before it is face to face,
    #     while every way is contested
    hold = waiting * may_depart + 0.5 * standing * at_switch * (1.0 - best_close)
    factor_yield = stop * hold * best_head_on

    # 12. Detour that the best branch costs
    factor_detour = -on_map * best_detour

    # 13. Near predicted conflict on the best branch
    factor_conflict = -on_map * best_conflict

    return [factor_arrived, factor_distance, factor_late, factor_hopeless,
            factor_flow, factor_head_on, factor_deadlock, factor_standing,
            factor_needless_stop, factor_idle_outside, factor_yield,
            factor_detour, factor_conflict]
