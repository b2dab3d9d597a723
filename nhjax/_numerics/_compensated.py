from jaxtyping import Array, Float


def two_sum(
    a: Float[Array, "*n"], b: Float[Array, "*n"]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Compute the rounded sum a + b and its exact rounding error (Knuth's TwoSum).

    Adding the error to the next increment makes the sum of many small increments
    accurate to about one rounding (Hairer, Lubich, Wanner, GNI, section VIII.5).
    """
    total = a + b
    b_in_total = total - a
    error = (a - (total - b_in_total)) + (b - b_in_total)
    return total, error
