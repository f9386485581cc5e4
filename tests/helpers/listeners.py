"""Listeners of a training run, and the metrics that two equal runs share."""


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


class AtStep(MessageListener):
    """Calls `action` once, when a run reaches `step`, and records the run's messages."""

    def __init__(self, step, action):
        super().__init__()
        self.step, self.action, self.is_due = step, action, True

    def on_step(self, step):
        if step == self.step and self.is_due:
            self.is_due = False
            self.action()

    def on_message(self, message):
        # The fixture `small` has settings for every algorithm, which are unused by all but one.
        if " makes no difference to " not in message:
            super().on_message(message)


def metrics_without_times(run):
    """Return the metrics of a run, without those that depend on the machine's speed."""
    return [{key: value for key, value in line.items() if not key.startswith("time/")} for line in run.metrics()]
