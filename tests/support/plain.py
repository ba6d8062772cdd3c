"""Plain twins of fast operations, which several tests compare with."""

import torch


def squared(a, b):
    return sum((x - y) ** 2 for x, y in zip(a, b, strict=True))


def plain_nearest(queries, points):
    distances = []
    indices = []
    for cloud_q, cloud_p in zip(queries, points, strict=True):
        for q in cloud_q:
            best = torch.tensor(torch.inf)
            place = -1
            for i, p in enumerate(cloud_p):
                d = squared(q, p)
                if d < best:
                    best = d
                    place = i
            distances.append(best)
            indices.append(place)
    shape = queries.shape[:2]
    return torch.stack(distances).view(shape), torch.tensor(indices).view(shape)


def plain_farthest(cloud, chosen, m, weight=None):
    cloud = cloud.tolist()
    chosen = list(chosen)
    weight = [1.0] * len(cloud) if weight is None else weight.tolist()
    while len(chosen) < m:
        best = -1.0
        place = -1
        for i, p in enumerate(cloud):
            if i in chosen:
                continue
            d = min(squared(p, cloud[j]) for j in chosen) * weight[i] ** 2
            if d > best:
                best = d
                place = i
        chosen.append(place)
    return chosen
