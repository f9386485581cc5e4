# lare: task: JobShop
# lare: kind: factors
# lare: model: Claude (Anthropic), recorded 2026-11-28, draw 1
# lare: sha256: efeef75730a2c9e36313717d8fc16a94032614e966f2d3b56fd73c7995cb2bd9
# lare: passed: read, finite
import numpy as np

def evaluation_func(observation, action):
    obs = np.asarray(observation, dtype=np.float64)
    act = np.asarray(action, dtype=np.float64)
    n = obs.shape[0]

    # candidates: (batch, 4 candidates, 5 entries)
    cand = obs[:, 0:20].reshape(n, 4, 5)
    op_time = cand[:, :, 0]
    tail = cand[:, :, 1]
    tail_ops = cand[:, :, 2]
    has_next = (tail_ops > 0.05).astype(np.float64)
    next_queue = cand[:, :, 3]
    next_free = cand[:, :, 4] * has_next

    pick = act[:, 0:4]
    picks = np.sum(pick, axis=1, keepdims=True)  # 1 if a job is picked, 0 if the machine stands
    stand = act[:, 4:5]

    waiting = np.clip(2.0 * obs[:, 20:21], 0.0, 1.0)
    load = np.clip(obs[:, 21:22], 0.0, 1.0)
    work_left = np.clip(obs[:, 22:23], 0.0, 1.0)
    busy = obs[:, 23:24]
    blocked = obs[:, 24:25]
    job_bound = np.clip(obs[:, 25:26], 0.0, 1.0)

    def of_pick(values):
        # value of the picked candidate; 0 when the machine stands
        return np.sum(pick * values, axis=1, keepdims=True)

    def of_mean(values):
        return np.mean(values, axis=1, keepdims=True)

    # 1. urgency given up against the most urgent candidate (work and operations still to come),
    #    heavier when the longest job bounds the rest of the schedule
    urgency = 0.7 * tail + 0.3 * tail_ops
    urgency_loss = np.max(urgency, axis=1, keepdims=True) - urgency
    factor_urgency = -(of_pick(urgency_loss) + stand * of_mean(urgency_loss)) * (0.5 + 0.5 * job_bound)

    # 2. delay from starting the picked job before the one with the longest tail: min(p_j, q_m - q_j),
    #    both in units of 9 time units; standing delays by one unit of time
    tail_gap = 3.0 * (np.max(tail, axis=1, keepdims=True) - tail)
    delay = np.minimum(op_time, tail_gap)
    factor_tail_delay = -(of_pick(delay) + stand / 9.0)

    # 3. missed chance to feed, and soon, a next machine that is free and without work
    feed = next_free * (1.0 - 0.5 * np.clip(op_time, 0.0, 1.0))
    factor_feed = of_pick(feed) - np.max(feed, axis=1, keepdims=True)

    # 4. work that already waits at the next machine, against the best candidate with a next operation
    least_queue = np.min(np.where(has_next > 0.5, next_queue, 1.0e3), axis=1, keepdims=True)
    queue_loss = has_next * np.maximum(next_queue - least_queue, 0.0)
    factor_queue = -(of_pick(queue_loss) + stand * of_mean(queue_loss))

    # 5. time for which the waiting jobs are held up beyond the shortest operation,
    #    heavier when many jobs wait; standing holds them up by one unit of time
    hold_loss = op_time - np.min(op_time, axis=1, keepdims=True)
    factor_hold = -(of_pick(hold_loss) + stand / 9.0) * waiting

    # 6. the machine stands although jobs wait, worst at the bottleneck and with a long queue
    factor_stand = -stand * (0.2 + 0.6 * load + 0.2 * waiting)

    # 7. share of the machines that work after this decision
    factor_use = np.clip(busy + picks / 6.0, 0.0, 1.0)

    # 8. machines without any work at hand while much is still to be started in the shop
    starved = np.clip(1.0 - busy - blocked, 0.0, 1.0)
    factor_starved = -starved * work_left

    return [factor_urgency, factor_tail_delay, factor_feed, factor_queue,
            factor_hold, factor_stand, factor_use, factor_starved]
