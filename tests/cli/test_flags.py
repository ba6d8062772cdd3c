import pytest

from mops_lightning.cli.train import flags_first
from mops_lightning.errors import UserError
from tests.support.command_line import call


@pytest.mark.parametrize(
    ("given", "ordered"),
    [
        ("m=8 --cfg job sampler=fps", "--cfg job m=8 sampler=fps"),
        ("m=8,16 -m --config-dir=x ~x +y=2", "-m --config-dir=x m=8,16 ~x +y=2"),
        ("m=8 --info", "--info m=8"),
        ("-m --config-dir sweeps m=8", "-m --config-dir sweeps m=8"),
        ("m=8 m=8 -p trainer m=8", "-p trainer m=8 m=8 m=8"),
        ("", ""),
    ],
)
def test_flags_first_any_order_keeps_all_arguments(given, ordered):
    assert flags_first(given.split()) == ordered.split()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("--multirn m=8", "no flag '--multirn'. Did you mean '--multirun'"),
        ("m=8 --conf x", "no flag '--conf'. Did you mean '--cfg'"),
        ("m=8 --out=here", "Settings are KEY=VALUE, without dashes."),
        ("m=8 --cfg", "--cfg/-c: expected one argument."),
        ("-m m=8,16 --cfg job", "--multirun and --cfg: give one of them."),
        ("--experimental-rerun config.pickle", "--experimental-rerun is not available"),
        ("m=8 --resolve", "write --cfg job --resolve."),
        ("--cfg jobs m=8", "--cfg/-c: invalid choice: 'jobs'"),
    ],
)
def test_flags_first_mistake_raises(given, said):
    with pytest.raises(UserError) as caught:
        flags_first(given.split())
    assert said in str(caught.value)


def test_flag_between_settings_is_read(tmp_path):
    status, out, _ = call(["m=8", "--cfg", "job", "sampler=fps"], tmp_path)
    assert status == 0
    assert "\nm: 8\n" in f"\n{out}"
    assert "FPSSampler" in out
