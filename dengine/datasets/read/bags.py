"""stub"""


def read_bag(*a):
    raise NotImplementedError
