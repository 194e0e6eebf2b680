"""Silicones of which soft robots are cast, in kilograms, metres and seconds.

Stresses are in pascals and densities in kilograms per cubic metre, so that forces and energies of a
plane body are those of a metre of depth. Shear moduli mu are of data sheets and measurements:

- Ecoflex 00-30 and Dragon Skin 30: Smooth-On's technical bulletins "Ecoflex Series" and "Dragon
  Skin Series" (ASTM D412 and D1475): 100 % moduli of 10 and 86 psi, specific gravities of 1.07 and
  1.08. The 100 % modulus is the nominal stress at twice the length, which of an incompressible
  neo-Hookean solid is mu (l - 1/l^2) at l = 2: 1.75 mu.
- Sylgard 184, 10:1, cured at 25 C: Young's modulus 1.32 MPa (I. D. Johnston et al., J. Micromech.
  Microeng. 24, 035017, 2014; 2.97 MPa if cured at 200 C); as it is nearly incompressible,
  mu = E / 3. Specific gravity 1.03 (Dow's data sheet).

What is published of one and the same silicone is spread widely, by curing and by the way of
measuring (of Sylgard 184: H. Varner, T. Cohen, Soft Matter, 2024, doi:10.1039/d4sm00573b).
Silicones also soften where they were stretched before, and creep (J. C. Case, E. L. White,
R. K. Kramer, Soft Robotics, 2015, doi:10.1089/soro.2015.0002); this law knows neither.

`POISSON` is a choice: silicones are nearly incompressible, with a ratio above 0.49. The stiffness
that bounds the step is 2 mu / (1 - 2 nu), so 0.45 takes twice as many steps as 0.3, and 0.49 takes
4.5 times as many.
"""

from mpmopt.scene.parts import Material

PSI = 6894.757  # Pa
POISSON = 0.45


def _cast(mu: float, density: float) -> Material:
    return Material.from_young(2.0 * mu * (1.0 + POISSON), POISSON, density)


SILICONES = {
    "Ecoflex 00-30": _cast(10.0 * PSI / 1.75, 1070.0),
    "Dragon Skin 30": _cast(86.0 * PSI / 1.75, 1080.0),
    "Sylgard 184": _cast(1.32e6 / 3.0, 1030.0),
}
