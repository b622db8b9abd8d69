from visdom_plugin.errors import EmptyHullError


def choose_k(domain, cameras, silhouettes):
    return min(3, len(silhouettes))


def explain_empty(domain, cameras, silhouettes):
    return EmptyHullError("no voxel satisfies the keep rule")
