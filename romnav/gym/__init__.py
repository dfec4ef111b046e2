"""The navigation task for other learners; importing this module makes ``gymnasium.make("romnav/RoM-v0")`` know it."""

import gymnasium

ID = "romnav/RoM-v0"

_WHERE = "romnav.gym.env"
gymnasium.register(ID, f"{_WHERE}:RoMEnv", vector_entry_point=f"{_WHERE}:RoMVectorEnv", order_enforce=False)
