"""A program that tries each feature briefly and prints the names of working ones."""

import jax


jax.config.update("jax_enable_x64", True)

from support import (  # noqa: E402
    features_of_derivatives,
    features_of_runs,
    features_of_systems,
)
from support.user_features import FEATURES  # noqa: E402


__all__ = ["features_of_derivatives", "features_of_runs", "features_of_systems"]


if __name__ == "__main__":
    for name, function in FEATURES.items():
        try:
            function()
        # If a feature fails, the others are still tried; the test of the failed one
        # fails, since its name is not alone on a line.
        except Exception as error:
            print(f"{name}: {type(error).__name__}: {error}".replace("\n", " "))
        else:
            print(name, flush=True)
