"""Recipes trained on one scene with several random seeds, and the table that says what each is worth."""
