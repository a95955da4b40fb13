"""The numbers of the paper (Nematollahi et al., T3VIP, 2022): best of 100 samples, means over the predicted frames."""

from __future__ import annotations

from dataclasses import dataclass

from worldmodel.study.plan import Contestant, StudyName

METRICS = ("psnr", "ssim", "vgg", "depth_rmse", "depth_absrel")
"""The columns of Tables I and II. Depth RMSE in metres; None where the paper has a cross."""
Numbers = tuple[float | None, float | None, float | None, float | None, float | None]
_NONE: Numbers = (None, None, None, None, None)


@dataclass(frozen=True)
class Setting:
    """What the paper measured on."""

    table: str
    dataset: str
    skip: int
    test_steps: int
    models: dict[str, Numbers]


TABLE_I = (
    Setting(
        "Table I", "DexHand", 0, 25,
        {
            "cdna": (20.254, 0.803, 0.825, None, None),
            "sna": (20.643, 0.814, 0.836, None, None),
            "sv2p": (20.892, 0.810, 0.836, None, None),
            "t3vip": (23.153, 0.889, 0.909, 0.024, 0.005),
        },
    ),
    Setting(
        "Table I", "CALVIN", 0, 60,
        {
            "cdna": (22.374, 0.847, 0.875, None, None),
            "sna": (22.279, 0.842, 0.881, None, None),
            "sv2p": (22.363, 0.844, 0.882, None, None),
            "t3vip": (22.692, 0.849, 0.857, 0.133, 0.006),
        },
    ),
    Setting(
        "Table I", "CALVIN", 2, 60,
        {
            "cdna": (19.397, 0.740, 0.779, None, None),
            "sna": (19.403, 0.739, 0.787, None, None),
            "sv2p": (19.408, 0.741, 0.791, None, None),
            "t3vip": (21.208, 0.779, 0.801, 0.125, 0.007),
        },
    ),
    Setting(
        "Table I", "Omnipush", 0, 60,
        {
            "cdna": (25.239, 0.877, 0.848, None, None),
            "sna": (23.855, 0.880, 0.871, None, None),
            "sv2p": (23.853, 0.884, 0.874, None, None),
            "t3vip": (24.261, 0.879, 0.893, 0.053, 0.023),
        },
    ),
    Setting(
        "Table I", "Omnipush", 2, 20,
        {
            "cdna": (25.304, 0.890, 0.865, None, None),
            "sna": (25.452, 0.903, 0.891, None, None),
            "sv2p": (25.730, 0.907, 0.891, None, None),
            "t3vip": (26.053, 0.899, 0.911, 0.050, 0.020),
        },
    ),
)  # fmt: skip
TABLE_II = (
    Setting(
        "Table II", "Omnipush", 2, 20,
        {
            "M1": _NONE,
            "M2": _NONE,
            "M3": (24.92, 0.88, 0.86, 0.06, 0.02),
            "M4": (25.29, 0.88, 0.89, 0.05, 0.02),
            "M5": (25.53, 0.89, 0.90, 0.05, 0.02),
            "M6": (26.05, 0.90, 0.91, 0.05, 0.02),
        },
    ),
)  # fmt: skip
"""The crosses of M1 and M2: the paper found them not to learn the dynamics, and gives no numbers."""
COUNTERPARTS = {"Tabletop": "CALVIN", "PlanarPush": "Omnipush", "DexHand": "DexHand"}
"""Which of the paper's datasets each of our environments stands in for."""


def setting_of(study: StudyName, gap: int, env_id: str) -> Setting | None:
    """What the paper measured that is nearest to a study on our data: same kind of data and same frame gap.

    Of the ablation there is Omnipush only. The paper's figure of action-free prediction gives no numbers in its text.
    """
    if study == "ablation":
        return TABLE_II[0]
    if study == "table":
        dataset = next((theirs for ours, theirs in COUNTERPARTS.items() if f"/{ours}" in env_id), None)
        for setting in TABLE_I:
            if (setting.dataset, setting.skip) == (dataset, gap - 1):
                return setting
    return None


def numbers_of(study: StudyName, contestant: Contestant, env_id: str) -> dict[str, float | None] | None:
    """The paper's scores of a contestant by metric, None where it gives none."""
    setting = setting_of(study, contestant.gap, env_id)
    if setting is None or contestant.name not in setting.models:
        return None
    return dict(zip(METRICS, setting.models[contestant.name], strict=True))
