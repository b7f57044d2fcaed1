"""Gains from design rules: `rules` finds and checks them, `patch` writes them into a profile, `page` shows them."""
