import numpy as np
import pytest

from smplxpp.core.rotations import matrix_from_rotvec
from smplxpp.skinning.linear_blend import blend_transforms, forward_kinematics, skin

# A small tree whose parents do not all come first.
PARENTS = np.array([2, 0, -1, 2, 3])


@pytest.fixture
def scene():
    rng = np.random.default_rng(0)
    weights = rng.random((40, 5)) * (rng.random((40, 5)) > 0.5) + 1e-3
    return {
        "joints": rng.normal(size=(3, 5, 3)),
        "rotations": matrix_from_rotvec(rng.normal(size=(3, 5, 3))),
        "vertices": rng.normal(size=(3, 40, 3)),
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "transl": rng.normal(size=(3, 3)),
    }


def naive_transforms(joints, rotations, transl):
    """One frame by the definition: products of 4x4 matrices along each joint's chain."""
    out = []
    for j in range(len(PARENTS)):
        chain, at = [], j
        while at >= 0:
            chain.append(at)
            at = PARENTS[at]
        world = np.eye(4)
        for at in reversed(chain):
            local = np.eye(4)
            local[:3, :3] = rotations[at]
            local[:3, 3] = joints[at] - (joints[PARENTS[at]] if PARENTS[at] >= 0 else -transl)
            world = world @ local
        world[:3, 3] -= world[:3, :3] @ joints[j]
        out.append(world)
    return np.array(out)


def test_transforms_and_skinning_equal_their_definition(scene):
    posed_from_rest, joints = forward_kinematics(scene["joints"], PARENTS, scene["rotations"], transl=scene["transl"])
    posed = skin(scene["vertices"], scene["weights"], posed_from_rest)
    for t in range(3):
        naive = naive_transforms(scene["joints"][t], scene["rotations"][t], scene["transl"][t])
        np.testing.assert_allclose(posed_from_rest[t], naive, atol=1e-13)
        homogeneous = np.concatenate([scene["vertices"][t], np.ones((40, 1))], axis=1)
        expected = np.einsum("vj,jab,vb->va", scene["weights"], naive, homogeneous)[:, :3]
        np.testing.assert_allclose(posed[t], expected, atol=1e-13)
        own = np.einsum("jab,jb->ja", naive[:, :3, :3], scene["joints"][t]) + naive[:, :3, 3]
        np.testing.assert_allclose(joints[t], own, atol=1e-13)


def test_frames_without_a_batch_axis(scene):
    whole, joints = forward_kinematics(scene["joints"], PARENTS, scene["rotations"])
    one, one_joints = forward_kinematics(scene["joints"][1], PARENTS, scene["rotations"][1])
    np.testing.assert_allclose(one, whole[1], atol=1e-14)
    np.testing.assert_allclose(one_joints, joints[1], atol=1e-14)
    posed = skin(scene["vertices"][1], scene["weights"], one)
    assert posed.shape == (40, 3) and posed.flags.c_contiguous
    np.testing.assert_allclose(posed, skin(scene["vertices"], scene["weights"], whole)[1], atol=1e-14)


def test_no_rotation_moves_nothing(scene):
    posed_from_rest, joints = forward_kinematics(scene["joints"], PARENTS, np.broadcast_to(np.eye(3), (3, 5, 3, 3)))
    np.testing.assert_allclose(posed_from_rest, np.broadcast_to(np.eye(4), (3, 5, 4, 4)), atol=1e-15)
    np.testing.assert_allclose(joints, scene["joints"], atol=1e-15)


def test_the_root_alone_moves_the_body_rigidly(scene):
    rotations = np.tile(np.eye(3), (3, 5, 1, 1))
    rotations[:, 2] = scene["rotations"][:, 2]
    posed_from_rest, _ = forward_kinematics(scene["joints"], PARENTS, rotations, transl=scene["transl"])
    pivot = scene["joints"][:, 2:3]
    expected = (scene["vertices"] - pivot) @ rotations[:, 2].swapaxes(1, 2) + pivot + scene["transl"][:, None]
    np.testing.assert_allclose(skin(scene["vertices"], scene["weights"], posed_from_rest), expected, atol=1e-13)


def test_the_order_of_joints_does_not_matter(scene):
    order = np.array([3, 1, 4, 2, 0])
    parents = np.array([-1 if PARENTS[j] < 0 else int(np.flatnonzero(order == PARENTS[j])[0]) for j in order])
    first, _ = forward_kinematics(scene["joints"], PARENTS, scene["rotations"])
    second, _ = forward_kinematics(scene["joints"][:, order], parents, scene["rotations"][:, order])
    np.testing.assert_allclose(second, first[:, order], atol=1e-13)


def test_blended_transforms_carry_the_points_that_skinning_does(scene):
    posed_from_rest, _ = forward_kinematics(scene["joints"], PARENTS, scene["rotations"])
    blended = blend_transforms(scene["weights"], posed_from_rest)
    assert blended.shape == (3, 40, 4, 4)
    np.testing.assert_allclose(blended[..., 3, :], np.broadcast_to([0, 0, 0, 1], (3, 40, 4)), atol=1e-15)
    moved = np.einsum("tvab,tvb->tva", blended[..., :3, :3], scene["vertices"]) + blended[..., :3, 3]
    np.testing.assert_allclose(moved, skin(scene["vertices"], scene["weights"], posed_from_rest), atol=1e-13)


def test_torch_agrees_and_its_gradients_are_right(scene):
    torch = pytest.importorskip("torch")

    def posed(rotvec, joints, vertices, transl):
        posed_from_rest, _ = forward_kinematics(joints, PARENTS, matrix_from_rotvec(rotvec), transl=transl)
        return skin(vertices, torch.tensor(scene["weights"][:6]), posed_from_rest)

    rotvec = np.zeros((3, 5, 3))
    rotvec[1:] = np.random.default_rng(3).normal(size=(2, 5, 3))
    inputs = [rotvec, scene["joints"], scene["vertices"][:, :6], scene["transl"]]
    tensors = [torch.tensor(a, requires_grad=True) for a in inputs]
    posed_from_rest, _ = forward_kinematics(
        scene["joints"], PARENTS, matrix_from_rotvec(rotvec), transl=scene["transl"]
    )
    expected = skin(scene["vertices"][:, :6], scene["weights"][:6], posed_from_rest)
    np.testing.assert_allclose(posed(*tensors).detach().numpy(), expected, atol=1e-13)
    assert torch.autograd.gradcheck(posed, tensors)
