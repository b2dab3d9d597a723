import pytest


@pytest.fixture(autouse=True, scope="module")
def kernels_of_users(optimised_kernels):
    """All that is tested here is what users have."""
