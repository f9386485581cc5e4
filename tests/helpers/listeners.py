"""Listeners of a training run, and the metrics that two equal runs share."""


class AtStep:
    """Calls `action` when a run reaches `step`, and records the run's messages."""

    def __init__(self, step, action):
        self.step, self.action, self.messages = step, action, []

    def on_start(self, name, step, steps): ...
    def on_evaluation(self, metrics): ...
    def on_stop(self): ...

    def on_message(self, message):
        # The fixture `small` gives settings for every algorithm, and every run is prepared.
        if " makes no difference to " not in message and not message.startswith("preparing "):
            self.messages.append(message)

    def on_step(self, step):
        if step == self.step:
            self.action()


class MessageListener:
    """Records the messages of a run."""

    def __init__(self):
        self.messages = []

    def on_start(self, name, step, steps): ...
    def on_step(self, step): ...
    def on_evaluation(self, metrics): ...
    def on_stop(self): ...

    def on_message(self, message):
        if not message.startswith("preparing "):
            self.messages.append(message)


def metrics_without_times(run):
    """Return the metrics of a run, without those that depend on the machine's speed."""
    return [{key: value for key, value in line.items() if not key.startswith("time/")} for line in run.metrics()]
