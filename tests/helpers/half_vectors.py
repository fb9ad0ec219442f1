"""Mitsuba's χ² test of a BSDF's sampling, in coordinates in which no lobe is too narrow for it."""

import math

import drjit as dr
import numpy as np
from arrays import aligned

#: Coarse cells a side, and fine cells a side of each of them.
COARSE_CELLS, BLOCK = 9, 6


class HalfVectorSampling:
    """What :class:`mi.chi2.ChiSquareTest` needs, in coordinates of the half vector: its azimuth, and of its polar angle
    ``v = ln(1 + q/a²) / ln(1 + 1/a²)`` with ``q = tan²(θ/2)`` and ``a = α/2``. A lobe of any width is smooth there,
    from α = 10⁻³ to a cosine: cells grow in proportion to the distance from the peak, and a lobe ten times as long as
    wide is a matter of azimuth.
    """

    def __init__(self, mi, bsdf, angle, alpha, ctx=None):
        self.mi, self.bsdf, self.ctx = mi, bsdf, ctx or mi.BSDFContext()
        theta = math.radians(angle)
        # Opaque, so that one kernel serves all angles and roughnesses
        x, z, a2 = (dr.opaque(mi.Float, v) for v in (math.sin(theta), math.cos(theta), alpha**2 / 4))
        self.wi, self.a2, self.log = mi.Vector3f(x * math.cos(0.7), x * math.sin(0.7), z), a2, dr.log(1 + 1 / a2)

    def interactions(self, n):
        si = dr.zeros(self.mi.SurfaceInteraction3f, n)
        si.wi = self.wi
        return si

    def sample(self, u):
        mi = self.mi
        bs, _ = self.bsdf.sample(self.ctx, self.interactions(dr.width(u)), u.x, mi.Point2f(u.y, u.z))
        valid = bs.pdf > 0
        h = dr.normalize(self.wi + dr.select(valid, bs.wo, self.wi))
        q = (dr.square(h.x) + dr.square(h.y)) / dr.square(1 + h.z)
        p = mi.Point2f(dr.atan2(h.y, h.x) / (2 * dr.pi) + 0.5, dr.log(1 + q / self.a2) / self.log)
        points, weights = dr.select(valid, p, 0.5), dr.select(valid, mi.Float(1), 0)
        dr.eval(points, weights)  # which the test reads twice
        return points, weights

    def pdf(self, p):
        return self.mapped(p, lambda si, wo: self.bsdf.pdf(self.ctx, si, wo))

    def mapped(self, p, function):
        """Return ``function(si, wo)``, per solid angle, as a density of the coordinates."""
        q = self.a2 * (dr.exp(p.y * self.log) - 1)
        sin, cos = 2 * dr.sqrt(q) / (1 + q), (1 - q) / (1 + q)
        sin_phi, cos_phi = dr.sincos(2 * dr.pi * (p.x - 0.5))
        h = self.mi.Vector3f(sin * cos_phi, sin * sin_phi, cos)
        wi_h = dr.dot(self.wi, h)
        wo = dr.fma(2 * wi_h, h, -self.wi)
        pdf = function(self.interactions(dr.width(p)), wo)
        # d(azimuth) dv → solid angle of h → of wo
        jacobian = 2 * dr.pi * self.log * (self.a2 + q) * 2 / dr.square(1 + q) * 4 * wi_h
        return dr.select((wi_h > 0) & (wo.z > 0), pdf * jacobian, 0)

    def test(self, pdf, cells, points):
        from mitsuba.chi2 import ChiSquareTest, PlanarDomain

        domain = PlanarDomain(self.mi.ScalarBoundingBox2f([0, 0], [1, 1]))
        return ChiSquareTest(domain, self.sample, pdf or self.pdf, 3, 1_000_000, cells, points)

    def faults(self, test_count, pdf=None):
        """Messages of the test in fine cells, which find what is wrong in a place, and in coarse ones, which find a
        little that is wrong everywhere; none if both accept. Also the number of samples that are valid. A coarse cell
        is a block of fine ones: the same samples and the same integrals of the density.
        """
        fine, coarse = self.test(pdf, COARSE_CELLS * BLOCK, 24), self.test(pdf, COARSE_CELLS, 2)
        fine.tabulate_histogram()
        fine.tabulate_pdf()
        vars(coarse).update({k: v for k, v in vars(fine).items() if k not in vars(coarse)})
        for name in ("histogram", "pdf"):
            cells = getattr(fine, name).numpy().astype(np.float64)
            blocks = cells.reshape(COARSE_CELLS, BLOCK, COARSE_CELLS, BLOCK).sum(axis=(1, 3))
            setattr(coarse, name, self.mi.Float(aligned(blocks.ravel())))
        messages = ""
        for test in (fine, coarse):
            if not test.run(test_count=2 * test_count, quiet=True):
                messages += test.messages
        return messages, float(dr.sum(fine.histogram)[0])
