"""From measured images to other settings: what noise they lack, and which materials they show."""
