"""Rules of parts and components: one joint, a chain of joints, each piece by itself."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.body import BodyModel, load_body
from smplxpp.core import GeometryWarning, InputError, TriangleMesh, concatenate_meshes
from smplxpp.people.garments.mannequin import Mannequin
from smplxpp.transfer import TransferConfig, transfer_weights
from tests.build.many_classes import bag_on_the_back


@pytest.fixture(scope="module")
def worn() -> tuple[BodyModel, TriangleMesh, TriangleMesh]:
    """The open body, a sleeve of its left arm's skin with a bag on the back, and the bag alone."""
    body = load_body()
    mannequin = Mannequin.of(body, np.zeros(body.num_betas))
    arm = body.weights[:, [body.joint_names.index(f"left_{name}") for name in ("shoulder", "elbow")]].sum(axis=1) > 0.5
    sleeve = body.mesh(body.v_template + 0.004 * body.mesh().vertex_normals).submesh(arm[body.faces].all(axis=1))[0]
    bag = bag_on_the_back(mannequin)
    return body, concatenate_meshes([sleeve, bag]), bag


def joints_of(body: BodyModel, dense: np.ndarray) -> set[str]:
    return {body.joint_names[j] for j in np.flatnonzero((dense > 1e-9).any(axis=0))}


def test_components_have_rules_of_their_own_also_where_they_match(worn):
    body, target, bag = worn
    plain = transfer_weights(body.mesh(), body.weights, target)
    count = target.vertex_count - bag.vertex_count
    rules = {0: "chain:left_shoulder,left_elbow", 1: "rigid:spine3"}
    config = TransferConfig(component_rules=rules)
    ruled = transfer_weights(body.mesh(), body.weights, target, config=config)
    dense = ruled.dense()
    assert ruled.policies == ("chain:left_shoulder,left_elbow", "rigid:spine3")
    assert joints_of(body, dense[:count]) == {"left_shoulder", "left_elbow"} < joints_of(body, plain.dense()[:count])
    np.testing.assert_allclose(dense.sum(axis=1), 1.0, atol=1e-12)
    # Weights of the chain are those of the skin, normalised: halfway down the sleeve nothing else was there.
    chain = [body.joint_names.index(f"left_{name}") for name in ("shoulder", "elbow")]
    own = plain.dense()[:count][:, chain]
    inner = own.sum(axis=1) > 0.999
    assert inner.sum() > 50
    assert np.abs(dense[:count][:, chain] - own)[inner].max() < 0.05
    # What has no rule keeps its weights bit for bit.
    half = transfer_weights(body.mesh(), body.weights, target, config=TransferConfig(component_rules={1: "isolate"}))
    np.testing.assert_array_equal(half.dense()[:count], plain.dense()[:count])
    assert half.policies[0] == "matched" and half.policies[1].startswith("rigid:")
    assert (half.dense()[count:].max(axis=1) == 1.0).all()


@pytest.mark.filterwarnings("error")
def test_a_closed_bag_on_the_back_is_not_inside_out(worn):
    """Most of its vertices near the body face against it; only a negative volume tells that a bag is turned."""
    body, _, bag = worn
    transfer_weights(body.mesh(), body.weights, bag)
    with pytest.warns(GeometryWarning, match="inside out"):
        transfer_weights(body.mesh(), body.weights, TriangleMesh(bag.vertices, bag.faces[:, ::-1]))


def test_misspelt_names_are_answered_with_the_right_one(worn):
    body, target, _ = worn
    for config, said in (
        ({"rule": "rigid:haed"}, "Did you mean 'head'"),
        ({"rule": "chain:left_sholder"}, "Did you mean 'left_shoulder'"),
        ({"component_rules": {7: "isolate"}}, "components 0 to 1"),
    ):
        with pytest.raises(InputError, match=said):
            transfer_weights(body.mesh(), body.weights, target, config=TransferConfig(**config))
    with pytest.raises(InputError, match="Did you mean 'lower'"):
        TransferConfig.for_label("lowr")
