"""Random pixels of an ImageStore: their coordinates and bytes (Numba)."""

from numba import njit, prange


@njit(parallel=True, cache=True, error_model="numpy")
def sample_pixels(
    piece, chance, images, first, count, stride, width, start, before, ahead, first_run, pixels, image, xy, rgba, where
):
    """Sample a pixel for each random number, and read its bytes, `piece` neighbours in the store at a time.

    The leading part of a number's 53 bits chooses the image, the rest the pixel.
    where: filled with positions in the store, unless it is empty
    """
    for p in prange(len(chance)):
        share = chance[p] * len(images)
        choice = min(int(share), len(images) - 1)
        k = images[choice]
        begin = int((share - choice) * count[k])
        for i in range(p * piece, min((p + 1) * piece, len(image))):
            position = begin + i - p * piece
            pixel = position
            if piece > 1:  # shuffled
                position %= count[k]
                pixel = position * stride[k] % count[k]
            if len(start):
                rank = pixel + ahead[k]
                low, high = first_run[k], first_run[k + 1]
                while high - low > 1:
                    middle = (low + high) // 2
                    if before[middle] <= rank:
                        low = middle
                    else:
                        high = middle
                pixel = start[low] + rank - before[low]
                if piece == 1:
                    position = pixel
            y = int((pixel + 0.5) / width[k])  # quicker than dividing whole numbers
            image[i] = k
            xy[i, 0] = pixel - y * width[k] + 0.5
            xy[i, 1] = y + 0.5
            rgba[i] = pixels[first[k] + position]
            if len(where):
                where[i] = first[k] + position
