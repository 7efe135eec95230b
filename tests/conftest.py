"""What holds for every test: no example of Hypothesis has a time limit, and a failing one prints how to repeat it."""

from hypothesis import settings

settings.register_profile("forefield", deadline=None, print_blob=True)
settings.load_profile("forefield")
