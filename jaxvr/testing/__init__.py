"""Checks for renderers: brute force, gradients, and inputs on which renderers fail.

Use these on your own tracer, integrator or adjoint, as this package does on its own:

    import jax, jaxvr
    from jaxvr import testing

    jax.config.update("jax_enable_x64", True)
    mesh = testing.nasty_meshes(only=["hollow"])["hollow"]
    transfer = testing.nasty_transfers()["jump"]
    camera = jaxvr.Camera.orbit(mesh, width=8, height=8)
    testing.assert_render_close(mesh, camera, transfer, tracer=jaxvr.KBuffer(k=16))
    testing.assert_gradients(
        lambda values: jaxvr.render(mesh.replace(values=values), camera, transfer),
        {"values": mesh.values},
    )

`brute` looks at every cell by itself, in NumPy, and shares no code with the rest of the package.
`gradients` compares reverse mode with differences that know their own error, and with itself in
other orders. `meshes` and `rays` are small and hostile. Nothing here needs a test framework, and no
other room imports from this one. To add a mesh, write a function of the dtype and name it in
`MESHES`; rays and transfer functions are entries of the dicts that their functions return.
"""

from jaxvr.testing.brute import BruteForce
from jaxvr.testing.gradients import GradientCheck, assert_gradients
from jaxvr.testing.meshes import FOLDED, MESHES, nasty_meshes
from jaxvr.testing.rays import nasty_rays, nasty_transfers, scaled
from jaxvr.testing.render import assert_render_close, brute_force

__all__ = [
    "FOLDED",
    "MESHES",
    "BruteForce",
    "GradientCheck",
    "assert_gradients",
    "assert_render_close",
    "brute_force",
    "nasty_meshes",
    "nasty_rays",
    "nasty_transfers",
    "scaled",
]
