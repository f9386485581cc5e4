"""The environment variables that LaRe reads. docs/reference/environment-variables.md is made from this table."""

import os

__all__ = ["VARIABLE_GROUPS", "read_variable"]

VARIABLE_GROUPS: dict[str, dict[str, str]] = {
    "LaRe": {
        "LARE_TRUST": (
            "Modules, separated by commas, that a file such as a run's may import. Without it, commands that read such a file "
            "import installed packages only, and `lare-rl report` none."
        ),
        "LARE_PLUGINS": "Modules, separated by commas, that register methods, decoders, algorithms or families.",
        "LARE_CACHE": "Directory of compiled programs; by default, in the user's cache directory. `off`: none.",
    },
    "Language model": {
        "OPENAI_API_KEY": "Key of the model, sent in the header of requests and written nowhere. Your own server may need none.",
        "OPENAI_BASE_URL": "Address of the model's server, without `--base-url`. By default, OpenAI's.",
    },
    "Simulators": {
        "MUJOCO_GL": "How MuJoCo draws films: `egl`, `osmesa` or `glfw`. On Linux without a screen, LaRe sets `egl`.",
        "DISPLAY": "The screen, under X11.",
        "WAYLAND_DISPLAY": "The screen, under Wayland.",
        "SC2PATH": "Folder of StarCraft II, for SMAC. By default, `~/StarCraftII`.",
    },
    "Processors": {
        "JAX_COMPILATION_CACHE_DIR": "JAX's own cache of compiled programs. If it is set, LaRe keeps none.",
        "OMP_NUM_THREADS": "Threads of numerical libraries in a process. By default, 1 in worker processes of environments.",
        "CUDA_VISIBLE_DEVICES": "NVIDIA's accelerators that a process sees. A sweep divides them among its runs.",
        "HIP_VISIBLE_DEVICES": "The same for AMD.",
        "XLA_PYTHON_CLIENT_PREALLOCATE": "`false`: JAX takes an accelerator's memory as needed. A sweep sets this if runs share one.",
    },
}
"""What each variable means, by subject."""


def read_variable(name: str) -> str:
    """Return the value of an environment variable without surrounding spaces, or an empty text if it is not set.

    Raises `KeyError` if the variable is not in `VARIABLE_GROUPS`.
    """
    if not any(name in group for group in VARIABLE_GROUPS.values()):
        raise KeyError(name)
    return os.environ.get(name, "").strip()
