from mops_lightning.config.compose import compose
from mops_lightning.training.run.parts import augmentation


def test_augmentation_of_joint_training_is_that_of_the_sampler():
    changed = ["augment.task.jitter=0.01", "+augment.sampler.jitter=0.02"]

    jitter = {}
    for learn in ("task", "sampler", "joint"):
        cfg = compose([*changed, f"learn={learn}"])
        jitter[learn] = augmentation(cfg).jitter

    assert jitter == {"task": 0.01, "sampler": 0.02, "joint": 0.02}
