"""HCNet's attention modules by plain loops over numbers, for comparison."""

import numpy as np


def relu(x):
    return np.maximum(x, 0.0)


def sigmoid(x):
    return 1.0 / (1.0 + np.exp(-x))


def pointwise_twice(x, parameters):
    """Two 1 x 1 convolutions, each followed by ReLU; parameters (W1, b1, W2, b2)."""
    w1, b1, w2, b2 = parameters
    hidden = relu(np.array([sum(w1[k, i] * x[i] for i in range(len(x))) + b1[k] for k in range(len(b1))]))
    return relu(np.array([sum(w2[k, i] * hidden[i] for i in range(len(hidden))) + b2[k] for k in range(len(b2))]))


def height_channel(images, height, channel):
    """Equations 1 to 3 of HCNet, pixel by pixel.

    Args:
        images: (B, C, H, W, N).
        height, channel: parameters of the branches, or None for a branch that is not there.

    Returns:
        (B, C, H, W).
    """
    batch, channels, rows, columns, slices = images.shape
    out = np.zeros((batch, channels, rows, columns))
    for b in range(batch):
        for i in range(rows):
            for j in range(columns):
                pixel = images[b, :, i, j, :]  # (C, N)
                of_slice = np.array([max(pixel[:, n]) for n in range(slices)])
                of_channel = np.array([max(pixel[c, :]) for c in range(channels)])
                heights = None if height is None else pointwise_twice(of_slice, height)
                widths = None if channel is None else pointwise_twice(of_channel, channel)
                for c in range(channels):
                    weighed = []
                    for n in range(slices):
                        a = 1.0
                        if heights is not None or widths is not None:
                            product = (1.0 if heights is None else heights[n]) * (1.0 if widths is None else widths[c])
                            a = sigmoid(product)
                        weighed.append(a * pixel[c, n])
                    out[b, c, i, j] = max(weighed)
    return out


def strip_weights(image, rows_kernel, columns_kernel):
    """Return the row and column responses (C, H) and (C, W) of equations 4 and 5 and a 3-tap convolution of each.

    Args:
        image: (C, H, W).
        rows_kernel, columns_kernel: (C, C, 3).
    """
    channels, height, width = image.shape
    of_row = np.array(
        [[sum(image[c, i, j] for j in range(width)) / width for i in range(height)] for c in range(channels)]
    )
    of_column = np.array(
        [[sum(image[c, i, j] for i in range(height)) / height for j in range(width)] for c in range(channels)]
    )
    return taps(of_row, rows_kernel), taps(of_column, columns_kernel)


def taps(signal, kernel):
    """Convolve (C, L) with (C, C, 3), zeros outside."""
    channels, length = signal.shape
    out = np.zeros((len(kernel), length))
    for o in range(len(kernel)):
        for p in range(length):
            for c in range(channels):
                for k in (-1, 0, 1):
                    if 0 <= p + k < length:
                        out[o, p] += kernel[o, c, k + 1] * signal[c, p + k]
    return out
