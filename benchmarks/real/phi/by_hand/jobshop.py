# Written by hand by the engineers of this task, who know its score. Not the reply of a language model to the texts alone.
import numpy as np


def evaluation_func(observation, action):
    jobs = np.reshape(observation[:, 0:20], (-1, 4, 5))
    choice = action[:, 0:4]
    wait = action[:, 4:5]
    # 1. work that remains of the job that was started, compared with the most
    f_work = np.sum(choice * jobs[:, :, 1], axis=1, keepdims=True) - np.max(jobs[:, :, 1], axis=1, keepdims=True)
    # 2. time of the operation that was started, compared with the shortest
    f_short = np.min(jobs[:, :, 0], axis=1, keepdims=True) - np.sum(choice * jobs[:, :, 0], axis=1, keepdims=True)
    # 3. the job goes on to a machine with nothing to do
    f_feed = np.sum(choice * jobs[:, :, 4], axis=1, keepdims=True)
    # 4. the job goes on to a machine with a long queue
    f_queue = -np.sum(choice * jobs[:, :, 3], axis=1, keepdims=True)
    # 5. a machine that waits, above all the one with the most work
    f_wait = -wait
    f_bottleneck_waits = -wait * observation[:, 21:22]
    # 6. machines stand although jobs wait
    f_idle = -observation[:, 24:25]
    # 7. share of machines that work
    f_busy = observation[:, 23:24]
    # 8. a long job is behind the busiest machine
    f_long_job = -observation[:, 25:26]
    return [f_work, f_short, f_feed, f_queue, f_wait, f_bottleneck_waits, f_idle, f_busy, f_long_job]
