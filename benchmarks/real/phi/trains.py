# lare: task: Trains
# lare: kind: factors
# lare: model: Claude (Anthropic), recorded 2026-11-28, draw 0
# lare: sha256: d0dbdb4cab956fcc0c2280f4290c751aad148b279dfa54f70f52c9e851a0015e
# lare: passed: read, finite
import numpy as np

def evaluation_func(observation, action):
    obs = np.nan_to_num(np.asarray(observation, dtype=np.float64), nan=0.0, posinf=10.0, neginf=-10.0)
    act = np.asarray(action, dtype=np.float64)

    waiting = (obs[:, 0:1] > 0.5).astype(np.float64)
    moving = (obs[:, 1:2] > 0.5).astype(np.float64)
    standing = (obs[:, 2:3] > 0.5).astype(np.float64)
    active = (obs[:, 3:4] <= 0.5).astype(np.float64)
    time_left = obs[:, 4:5]
    slack = obs[:, 5:6]
    until_departure = np.clip(obs[:, 6:7], 0.0, 10.0)
    ready_wait = waiting * (until_departure <= 1e-6).astype(np.float64)
    distance = np.clip(obs[:, 7:8], 0.0, 4.0)

    # the three branches as columns: left, ahead, right
    start = np.array([8, 13, 18])
    exists = obs[:, start] > 0.5
    detour = np.clip(obs[:, start + 1], 0.0, 10.0)
    detour_cost = np.clip(detour, 0.0, 1.0)
    near = np.clip(obs[:, start + 2], 0.0, 1.0)
    oncoming = np.clip(5.0 * obs[:, start + 3], 0.0, 1.0)
    same_direction = np.clip(5.0 * obs[:, start + 4], 0.0, 1.0)
    any_branch = np.any(exists, axis=1, keepdims=True)

    # head-on risk, larger when the other train is near; trains or conflicts directly in front
    head_on = oncoming * (0.5 + 0.5 * near)
    close = np.clip(2.0 * near, 0.0, 1.0)

    def best_branch(cost, without_branch):
        # smallest cost over the existing branches
        lowest = np.min(np.where(exists, cost, 10.0), axis=1, keepdims=True)
        return np.where(any_branch, np.clip(lowest, 0.0, 1.5), without_branch)

    # 1. the train has not arrived yet
    f_arrival = -active

    # 2. remaining distance to the target
    f_distance = -active * distance

    # 3. lateness: early warning in the last 5 time steps of slack, then graded
    warning = np.clip(1.0 - slack / 0.1, 0.0, 1.0)
    f_late = -active * (0.3 * warning + np.clip(-slack, 0.0, 1.0))

    # 4. the target can no longer be reached before the end
    needed = distance + waiting * until_departure
    f_out_of_time = -active * (needed > time_left + 1e-6).astype(np.float64)

    # 5. deadlock: on the map, and even the best branch has oncoming trains or a long detour
    exposure = np.clip(0.6 * moving + standing, 0.0, 1.0)
    f_deadlock = -active * exposure * best_branch(head_on + 0.3 * detour_cost, 0.0)

    # 6. stuck: standing with a train directly in front on every branch
    f_stuck = -active * standing * best_branch(close * (0.4 + 0.6 * oncoming), 0.0)

    # 7. moving or entering although the shortest branch holds a conflict
    crossing = near * (1.0 - oncoming) * (1.0 - same_direction)
    risk = np.maximum(head_on, crossing)
    shortest = np.argmin(np.where(exists, detour + 0.001 * risk, 1000.0), axis=1)
    risk_shortest = risk[np.arange(obs.shape[0]), shortest].reshape(-1, 1)
    risk_shortest = np.where(any_branch, risk_shortest, 0.0)
    f_into_conflict = -active * moving * risk_shortest

    # 8. idling although a branch is clear, above all by choice
    hazard = np.maximum(oncoming, close)
    clear = 1.0 - np.clip(best_branch(hazard + detour_cost, 1.0), 0.0, 1.0)
    stop = (act[:, 3:4] > 0.5).astype(np.float64)
    not_entering = (act[:, 1:2] <= 0.5).astype(np.float64)
    idle = standing * (0.5 + 0.5 * stop) + ready_wait * (0.5 + 0.5 * not_entering)
    f_idle = -active * np.clip(idle, 0.0, 1.0) * clear

    # 9. time lost: standing on the map, or still outside after the earliest departure
    f_held_up = -active * np.clip(standing + 0.5 * ready_wait, 0.0, 1.0)

    return [f_arrival, f_distance, f_late, f_out_of_time, f_deadlock, f_stuck, f_into_conflict, f_idle, f_held_up]
