"""What a step without a computed block comes to where stem and tail are simple; the interface of its piece.

Such an *idle* step adds a known sum of residuals to the stream, so that sample and prediction are bound by::

    stream     = stem(sample) + total          affine in the sample, each token for itself
    prediction = head(normalise(stream))       a LayerNorm, then affine, each token for itself

The stream of a token has W numbers, but moves in as many directions as a sample has dimensions, D. With an orthonormal
basis E of these directions, u what the total and the stem's constants say of the token, centred, and x its sample::

    y          = [x R + u E, rest] / sqrt(W)   rest^2 = |u - (u E) E'|^2 + W eps; its squares add up to the variance
    prediction = (x A H + u H) / |y| + h

All but x is known as soon as the total is, which many steps in a row share. So a step is arithmetic on numbers of the
size of the sample, in place of tensors of T x W and of seventeen operations of a session.
"""

from __future__ import annotations

IDLE = "idle"
"""Name of the piece: from a total to what the steps need of it. Artifacts of networks of another form have none."""

TOTAL = "total"
"""Input: the sum of a step's residuals, of the type of the residual stream."""

BASE, PRODUCT, SHIFT = "base", "product", "shift"
OUTPUTS = (BASE, PRODUCT, SHIFT)
"""``base [2 D + 1, B, T]``, what is added to ``product [2 D + 1, D] @ x``: rows of y, then those of the numerator; and
``shift [D, 1, T]``, what is added to the quotient. The last two depend on nothing."""
