"""Programs that JAX compiles (`from helpers.compilations import record_compilations`)."""

import contextlib

import jax


@contextlib.contextmanager
def record_compilations():
    """Yield a list that has an entry for each program compiled within the context."""
    compiled = []

    def listen(event, seconds, **_):
        if "backend_compile" in event:
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield compiled
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
