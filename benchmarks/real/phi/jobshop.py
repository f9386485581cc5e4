# lare: task: JobShop
# lare: kind: factors
# lare: model: Claude (Anthropic), recorded 2026-11-28, draw 0
# lare: sha256: b3f678ecfc377e5c846f697ac535742bc289ec30099a6afed52e2ba8a504a3b4
# lare: passed: read, finite
import numpy as np

def evaluation_func(observation, action):
    obs = np.asarray(observation, dtype=float)
    act = np.asarray(action, dtype=float)
    n = obs.shape[0]

    # candidates: (batch, 4 candidates, 5 entries), in the order of the first four actions
    cand = obs[:, 0:20].reshape(n, 4, 5)
    op_time = cand[:, :, 0]
    tail = cand[:, :, 1]
    has_next = (cand[:, :, 2] > 1e-6).astype(float)
    next_queue = np.clip(cand[:, :, 3], 0.0, 1.0)
    next_free = cand[:, :, 4]

    pick = act[:, 0:4]
    stand = act[:, 4]

    waiting = np.clip(obs[:, 20], 0.0, 1.0)
    machine_load = np.clip(obs[:, 21], 0.0, 1.0)
    work_left = np.clip(obs[:, 22], 0.0, 1.0)
    long_job = np.clip(obs[:, 25], 0.0, 1.0)
    # machines that neither work nor have a job waiting
    starved = np.clip(1.0 - obs[:, 23] - obs[:, 24], 0.0, 1.0)

    # 1. longest tail first: work after the picked job against the best candidate;
    #    standing delays the longest tail by one unit of time
    tail_loss = np.max(tail, axis=1, keepdims=True) - tail
    tail_regret = np.sum(pick * tail_loss, axis=1) + stand / 27.0
    urgency = -tail_regret * (0.4 + 0.3 * long_job + 0.3 * machine_load)

    # 2. bound on the end of the candidates after the choice, against the best choice;
    #    candidates with equal entries count as the same job
    p = op_time * 9.0
    total = p + tail * 27.0
    diff = np.abs(cand[:, :, None, :] - cand[:, None, :, :])
    same = np.all(diff < 1e-6, axis=3)
    others = np.max(np.where(same, 0.0, total[:, None, :]), axis=2)
    bound = np.maximum(total, p + others)
    bound_loss = bound - np.min(bound, axis=1, keepdims=True)
    bound_regret = (np.sum(pick * bound_loss, axis=1) + stand) / 27.0
    critical = -bound_regret * (0.3 + 0.7 * long_job)

    # 3. chance to supply a free and empty machine, used or missed
    feed = has_next * next_free * (1.0 - 0.5 * op_time)
    feeding = np.sum(pick * feed, axis=1) - np.max(feed, axis=1)

    # 4. job sent into a longer queue than another candidate would meet
    queue_min = np.min(np.where(has_next > 0.5, next_queue, 10.0), axis=1, keepdims=True)
    queue_loss = has_next * np.maximum(next_queue - queue_min, 0.0)
    congestion = -np.sum(pick * queue_loss, axis=1)

    # time for which the machine is occupied beyond what is needed; standing wastes one unit
    time_loss = op_time - np.min(op_time, axis=1, keepdims=True)
    excess = np.sum(pick * time_loss, axis=1) + stand / 9.0

    # 5. that time holds up the other waiting jobs
    holding = -excess * waiting

    # 6. that time releases work late while other machines starve
    release = -excess * starved

    # 7. letting the machine stand although jobs wait, worst on the bottleneck
    standing = -stand * (0.3 + 0.7 * machine_load)

    # 8. machines have nothing to do although work is still to be started
    starvation = -starved * work_left

    # 9. one long job still dominates although little work is left to start
    imbalance = -long_job * (1.0 - work_left)

    factors = [urgency, critical, feeding, congestion, holding, release, standing, starvation, imbalance]
    return [f.reshape(n, 1) for f in factors]
