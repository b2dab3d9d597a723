import pytest


@pytest.fixture(autouse=True, scope="module")
def kernels_of_users(optimised_kernels):
    """Test kernels as users have them."""
