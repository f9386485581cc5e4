"""The score of each task, computed again in another way; and splits that have no episode in common."""

import datetime
import xml.etree.ElementTree as ET

import numpy as np
import pytest


def test_wheat_score_by_a_calendar_of_doses(make):
    """PCSE plays the same doses from an agenda, without our steps."""
    env = make("wheat")
    from pcse.base import ParameterProvider
    from pcse.models import LINTUL3

    from final_score import wheat

    env.reset(options={"year": 1984})
    weeks, info, ended = {1: 0.5, 5: 1.0, 8: 0.25, 11: 0.01}, {}, False
    week = 0
    while not ended:
        *_, ended, _, info = env.step(np.array([weeks.get(week, 0.0)]))
        week += 1
    emergence = datetime.date(1984, 3, 31)
    # A dose between two days is spread on the second one.
    table = [
        {
            emergence + datetime.timedelta(days=7 * week + 1): {
                "amount": 6 * share,
                "recovery": 0.7,
                "N_amount": 6 * share,
                "N_recovery": 0.7,
            }
        }
        for week, share in weeks.items()
        if share > 0.05
    ]
    doses = {"event_signal": "apply_n", "name": "doses", "comment": "", "events_table": table}
    calendar = {
        "crop_name": "wheat",
        "variety_name": "spring-wheat",
        "crop_start_date": emergence,
        "crop_start_type": "emergence",
        "crop_end_date": datetime.date(1984, 10, 20),
        "crop_end_type": "earliest",
        "max_duration": 300,
    }
    provider, crop, soil, site = wheat.data()
    agenda = [{datetime.date(1984, 1, 1): {"CropCalendar": calendar, "TimedEvents": [doses], "StateEvents": None}}]
    model = LINTUL3(ParameterProvider(sitedata=site, soildata=soil, cropdata=crop), provider, agenda)
    model.run_till_terminate()
    grain = 10 * max(day["WSO"] or 0 for day in model.get_output())
    assert info["grain"] == pytest.approx(grain)
    assert info["score"] == pytest.approx((0.2 * info["grain"] - 1.2 * 105 - 3 * 8) / 100)


def test_traffic_delays(make):
    """All trips of the day count, also those that did not end or never entered the net, with the times of SUMO's file."""
    env = make("traffic")
    env.reset(options={"day": 3})
    folder = env.read("_demand").parent
    n_trips = len(ET.parse(folder / "demand.rou.xml").getroot().findall("trip"))
    ended, info = False, {}
    for index in range(360):
        *_, ended, _, info = env.step(index // 3 % 3)
    assert ended
    assert info["trips"] == n_trips
    trips = ET.parse(folder / "trips.xml").getroot()
    waiting = [float(trip.get("waitingTime")) for trip in trips]
    lost = [float(trip.get("timeLoss")) + float(trip.get("departDelay")) for trip in trips]
    assert all(a <= b + 1e-6 for a, b in zip(waiting, lost, strict=True))
    assert info["score"] == pytest.approx(-sum(lost) / n_trips)
    assert info["longest_delay"] == max(lost)


def test_jobshop_schedule(make):
    """The schedule is feasible, and its end is the makespan."""
    env = make("jobshop")
    for instance in range(3):
        env.reset(options={"instance": instance})
        random, ended, info = np.random.default_rng(instance), False, {}
        while not ended:
            *_, ended, _, info = env.step(random.integers(5))
        starts, durations, machines = np.asarray(env._state.scheduled_times), env._durations, env._machines
        ends = starts + durations
        assert (starts >= 0).all()
        assert (starts[:, 1:] >= ends[:, :-1]).all()
        for machine in range(machines.max() + 1):
            order = np.argsort(starts[machines == machine])
            assert (starts[machines == machine][order][1:] >= ends[machines == machine][order][:-1]).all()
        assert info["makespan"] == ends.max() >= info["bound"]
        assert info["score"] == pytest.approx(100 - 100 * ends.max() / info["bound"])


def test_jobshop_waits_cannot_stop_the_shop(make):
    """If all machines wait, the first one starts a job all the same. No episode is cut, which would have no score."""
    env = make("jobshop")
    for instance in (0, 29):  # the second would have 446 decisions
        env.reset(options={"instance": instance})
        ended, truncated, info, n_decisions = False, False, {}, 0
        while not (ended or truncated):
            *_, ended, truncated, info = env.step(4)
            n_decisions += 1
        assert ended
        assert n_decisions <= 400
        assert info["makespan"] < env._durations.sum()


def test_trains_delays(make):
    """A train that arrives is as late as the timetable says."""
    from final_score.trains import MAPS

    assert MAPS["train"][1] <= MAPS["test"][0]
    env = make("trains")
    observations, _ = env.reset(options={"map": 5})
    from final_score.trains import wait_while_blocked

    policy, infos = wait_while_blocked(env), {}
    while env.agents:
        observations, *_, infos = env.step({agent: policy(observations[agent]) for agent in env.agents})
    arrived = [train for train in env._rail.agents if train.arrival_time is not None]
    assert arrived
    for train in arrived:
        delay = max(0, train.arrival_time - train.latest_arrival)
        assert infos[f"train_{train.handle}"]["delay"] == delay
    assert infos["train_0"]["score"] == -np.mean([info["delay"] for info in infos.values()])
    assert infos["train_0"]["arrived"] == len(arrived) / 5


def test_grid_energy(make):
    """Losses and served energy, from Grid2Op alone."""
    env = make("grid")
    from final_score import grid

    env.reset(options={"week": 3, "day": 1})
    ended, info = False, {}
    while not ended:
        *_, ended, _, info = env.step(0)
    plain = grid.make_grid()
    plain.reset(seed=0, options={"time serie id": 3, "init ts": 288})
    losses = served = 0.0
    blackout, n_steps = False, 0
    while not blackout and n_steps < 288:
        observation, _, blackout, _ = plain.step(plain.action_space({}))
        n_steps += 1
        if not blackout:
            served += observation.load_p.sum() / 12
            losses += (observation.gen_p.sum() - observation.load_p.sum()) / 12
    plain.close()
    assert info["losses"] == pytest.approx(losses, rel=1e-5)
    assert info["unserved"] == pytest.approx(grid.day_energy(3, 1) - served, abs=1e-3)
    assert info["score"] == pytest.approx(-100 * (info["losses"] + info["unserved"]) / grid.day_energy(3, 1))
