"""Settings inside groups: how they differ from their group, and their limits."""

from typing import Any

from mops_lightning.config.declaration import Affects, Limits, number, one_of, or_null, whole

PRECISIONS = ("32-true", "bf16-mixed", "16-mixed")
"""What ``trainer.precision`` may be; Lightning has more."""

STANDARD_DEVIATION = number("of at least 0", lambda x: x >= 0)
WHOLE_OR_NULL = or_null(whole(1))
SHARE_OR_NULL = or_null(number("between 0 and 1", lambda x: 0 <= x <= 1))


CLIPS = Limits(
    "null or a number above 0",
    lambda x: x is None or (isinstance(x, int | float) and not isinstance(x, bool) and x > 0),
)

_NOTHING = {"affects": Affects.NOTHING}
INSIDE: dict[str, dict[str, Any]] = {
    "callbacks.learning_rate": _NOTHING,
    "callbacks.checkpoint": _NOTHING,
    "callbacks.progress": _NOTHING,
    "callbacks.pictures": _NOTHING,
    # A record may come from anybody: it chooses neither addresses nor where files are written.
    "dataset.cache": {**_NOTHING, "repeat": False},
    "dataset.download": {"repeat": False},
    "task.pairs.test_seed": {"affects": Affects.SCORES},
    "sampler.m": {"compare": False},
    "sampler.m_max": {"compare": False, "limits": whole(1)},
    "sampler.seed": {"compare": False},
    "augment.task.jitter": {"limits": STANDARD_DEVIATION},
    "augment.sampler.jitter": {"limits": STANDARD_DEVIATION},
    "recipe.train_points": {"limits": WHOLE_OR_NULL},
    "recipe.task_points": {"limits": WHOLE_OR_NULL, "learn": None},
    "recipe.all_points_from": {"limits": SHARE_OR_NULL},
    "recipe.warm_start": {
        "limits": Limits("true, false or a weights file", lambda x: isinstance(x, bool | str))
    },
    "recipe.distillation": {"limits": number("of at least 0", lambda x: x >= 0)},
    "recipe.feature_distillation": {"limits": number("of at least 0", lambda x: x >= 0)},
    "recipe.straight_through": {"limits": SHARE_OR_NULL},
    "recipe.straight_through_set": {"limits": one_of("matched", "completed")},
    "recipe.ema_span": {"limits": SHARE_OR_NULL},
    "sampler.threshold": {
        "affects": Affects.SCORES,
        "limits": number("of at least 0 and below 1", lambda x: 0 <= x < 1),
    },
    # Before the settings that take their values from them, so that an error names these.
    "epochs.task": {"limits": whole(1)},
    "epochs.sampler": {"limits": whole(0)},
    "trainer.max_epochs": {"limits": whole(0)},
    "trainer.precision": {"limits": one_of(*PRECISIONS, others=("32", 32, None))},
    "trainer._target_": _NOTHING,
    "trainer.accelerator": _NOTHING,
    "trainer.devices": _NOTHING,
    "trainer.num_nodes": _NOTHING,
    "trainer.strategy": _NOTHING,
    "trainer.log_every_n_steps": {**_NOTHING, "limits": whole(1)},
    "trainer.gradient_clip_val": {"limits": CLIPS},
}
"""Settings inside groups: how they differ from their group."""
