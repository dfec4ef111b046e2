"""The navigation task for other learners: ``gymnasium.make("romnav/RoM-v0")`` and ``gymnasium.make_vec``."""

from __future__ import annotations

ID = "romnav/RoM-v0"


def register() -> None:
    """Make the task known to Gymnasium, which calls this by itself where romnav is installed."""
    import gymnasium

    if ID not in gymnasium.registry:
        where = "romnav.gym.env"
        # an episode ends by itself, and checks of every step would take longer than the step
        gymnasium.register(ID, f"{where}:RoMEnv", vector_entry_point=f"{where}:RoMVectorEnv", order_enforce=False)


register()
