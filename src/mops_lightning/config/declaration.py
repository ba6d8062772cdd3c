"""The declaration of a setting: its effect, its trainings, whether an evaluation may change it."""

from dataclasses import dataclass
from enum import Enum, Flag, auto

from mops_lightning.config.limits import Limits


class Affects(Flag):
    """The effect of a setting.

    ``TRAINING`` is what is learned: such a setting belongs to the identity of a resumed run and to
    the key of a cached task net. ``SCORES`` is what is measured on the test clouds. Settings that
    affect ``NOTHING`` may differ between two starts of a sweep.
    """

    NOTHING = 0
    TRAINING = auto()
    SCORES = auto()
    RESULTS = TRAINING | SCORES


class Training(Flag):
    """The trainings that a run may have.

    ``FIRST`` is the training of a task net by ``weights=auto``; with ``learn=task`` its start.
    ``TASK_NET`` is the training of a task net on all points, ``JOINT`` on sampled points.
    ``SAMPLER`` is the training of a sampler, with or without its task net.
    """

    FIRST = auto()
    TASK_NET = auto()
    JOINT = auto()
    SAMPLER = auto()


class InEvaluation(Enum):
    """Whether an evaluation may change a setting of the run that it tests.

    ``FOR_NEW_NET`` is a setting of the training of another task net by ``weights=auto``.
    """

    CHANGES = auto()
    FOR_NEW_NET = auto()
    STAYS = auto()


@dataclass(frozen=True)
class Setting:
    """One setting.

    Attributes:
        help: its text in ``--help``.
        affects: what it changes.
        limits: the values it takes; None: all of its type.
        learn: the values of ``learn`` with which it counts; None: with all; (): with none.
        group: whether it is a group of choices, which ``--help`` lists elsewhere.
        nullable: whether it may be removed or null.
        per_learn: whether it has one entry for learn=task and one for training a sampler.
        serves: the trainings that it is a setting of; None: it belongs to no training alone.
        by_content: whether a run is identified by the content of the files that it names.
        repeat: whether ``evaluate=RUN`` takes it from RUN; None: if it affects anything.
        evaluation: whether an evaluation may change it; None: unless it affects what is learned.
        compare: whether ``report`` refuses runs in one table that differ in it; None: if it
            affects anything.
    """

    help: str = ""
    affects: Affects = Affects.RESULTS
    limits: Limits | None = None
    learn: tuple[str, ...] | None = None
    group: bool = False
    nullable: bool = False
    per_learn: bool = False
    serves: Training | None = None
    by_content: bool = False
    repeat: bool | None = None
    evaluation: InEvaluation | None = None
    compare: bool | None = None

    def counts(self, learn: str) -> bool:
        """Return whether it makes a difference with this value of ``learn``."""
        return self.learn is None or learn in self.learn

    @property
    def affects_training(self) -> bool:
        """Whether it changes what is learned."""
        return Affects.TRAINING in self.affects

    def is_of(self, trainings: Training) -> bool:
        """Return whether it is a setting of one of these trainings, or of none alone."""
        return self.serves is None or bool(self.serves & trainings)

    @property
    def repeated(self) -> bool:
        """Whether ``evaluate=RUN`` takes it from RUN."""
        if self.repeat is not None:
            return self.repeat
        return bool(self.affects)

    @property
    def in_evaluation(self) -> InEvaluation:
        """Whether an evaluation may change it."""
        if self.evaluation is not None:
            return self.evaluation
        if self.affects_training:
            return InEvaluation.STAYS
        return InEvaluation.CHANGES

    @property
    def compared(self) -> bool:
        """Whether ``report`` compares it."""
        if self.compare is not None:
            return self.compare
        return bool(self.affects)
