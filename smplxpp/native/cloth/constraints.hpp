// What a garment is (Model, Forces), and its edges and hinges, which are solved in the order of their arrays (Gauss-Seidel), in
// batches of four that share no particle.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <numeric>
#include <vector>

#include "cloth/lanes.hpp"
#include "cloth/vec3.hpp"

namespace smplxpp {

// What a garment is, over n particles, m faces, e edges, b hinges and a collider of c vertices and d faces.
// smplxpp/cloth/solver.py says the same.
struct Model {
    int64_t particles, faces, edges, hinges, collider_vertices, collider_faces;
    const float* inverse_mass;         // n: 1/kg, 0: follows its place exactly
    const int32_t* face;               // 3 m
    const int32_t* edge;               // 2 e
    const float* length;               // e: metres at rest
    const float* stretch;              // e: m/N where it is longer
    const float* compress;             // e: m/N where it is shorter
    const int32_t* hinge;              // 4 b: the edge's ends, then the corners across
    const float* curvature;            // 4 b: weights of the corners in the curvature vector
    const float* rest_curvature;       // b: along the hinge's normal
    const float* bend;                 // b: compliance
    const float* spring;               // n: m/N of the spring to its place, inf: none; null: nobody has one
    const int32_t* anchor;             // n: particle of the tether, -1: none
    const float* tether;               // n: metres at most
    const float* apart;                // n: metres at rest to the nearest particle that no edge joins to it
    const int32_t* collider_face;      // 3 d
    const float* margin;               // c: metres that cloth keeps from it
    const float* deepest;              // c: metres; deeper cloth is on the other side
};

struct Forces {
    double gravity, drag, normal_drag, inner_friction, friction, own_margin, most_speed;
    double most_stretch;  // of an edge, over its length at rest
    int64_t* report;      // 2: contacts that were let go, particles that follow their places and were moved from these
};

// How the ends of an edge share what corrects it.
enum Sharing { kShared, kLedDown, kSliding };

// Places and velocities are n of particles, and one that nothing moves, which lanes without a constraint have.
class Constraints {
public:
    // What of edges and hinges is the same in all substeps, in batches. Empty lanes have the particle n, which nothing moves.
    Constraints(const Model& model, const Forces& forces, float h) : m_(model) {
        const float over = 1.0f / (h * h), share = std::min(0.45f, float(forces.inner_friction) * h);
        const int32_t none = int32_t(m_.particles);
        const std::vector<Lanes> of_edges = in_batches<2>(m_.edge, m_.edges, m_.particles);
        edges_.reserve(of_edges.size());
        for (const Lanes& batch : of_edges) {
            Edges& four = edges_.emplace_back();
            std::fill_n(four.i, kLanes, none), std::fill_n(four.j, kLanes, none);
            four.stretched = four.compressed = all_lanes(1);
            for (int lane = 0; lane < kLanes; ++lane) {
                const int32_t k = batch[size_t(lane)];
                if (k < 0) continue;
                const int32_t i = four.i[lane] = m_.edge[2 * k], j = four.j[lane] = m_.edge[2 * k + 1];
                const float masses = w(i) + w(j), most = float(forces.most_stretch) * m_.length[k];
                four.mass_i[lane] = w(i), four.mass_j[lane] = w(j), four.length[lane] = m_.length[k];
                four.stretched[lane] = std::max(masses + m_.stretch[k] * over, 1e-20f);
                four.compressed[lane] = std::max(masses + m_.compress[k] * over, 1e-20f);
                four.drags[lane] = masses == 0 || share <= 0 ? 0.0f : share / masses;
                four.most[lane] = most, four.most_squared[lane] = most * most;
            }
        }
        first_edge_.assign(size_t(m_.particles) + 1, 0);
        for (int64_t k = 0; k < 2 * m_.edges; ++k) ++first_edge_[size_t(m_.edge[k])];
        std::partial_sum(first_edge_.begin(), first_edge_.end(), first_edge_.begin());
        edge_of_.resize(size_t(2 * m_.edges));
        for (size_t batch = 0; batch < edges_.size(); ++batch)
            for (int lane = 0; lane < kLanes; ++lane)
                for (const int32_t end : {edges_[batch].i[lane], edges_[batch].j[lane]})
                    if (end < none) edge_of_[size_t(--first_edge_[size_t(end)])] = int32_t(batch);
        const std::vector<Lanes> of_hinges = in_batches<4>(m_.hinge, m_.hinges, m_.particles);
        hinges_.reserve(of_hinges.size());
        for (const Lanes& batch : of_hinges) {
            Hinges& four = hinges_.emplace_back();
            four.stiff = all_lanes(1);
            for (int lane = 0; lane < kLanes; ++lane) {
                const int32_t k = batch[size_t(lane)];
                for (int j = 0; j < 4; ++j) four.corner[j][lane] = k < 0 ? none : m_.hinge[4 * k + j];
                if (k < 0) continue;
                float stiff = m_.bend[k] * over;
                for (int j = 0; j < 4; ++j) {
                    const float c = m_.curvature[4 * k + j], mass = w(four.corner[j][lane]);
                    four.curvature[j][lane] = c, four.moves[j][lane] = mass * c;
                    stiff += mass * c * c;
                }
                four.rest[lane] = m_.rest_curvature[k], four.stiff[lane] = std::max(stiff, 1e-20f);
            }
        }
    }

    void stretch(std::vector<Vec4>& x) const {
        for (const Edges& e : edges_) {
            Vec4 d[kLanes];
            along(x, e, d);
            const Vec4 l = length(columns(d[0], d[1], d[2], d[3])), error = l - e.length;
            const Vec4 stiff = select(error < 0, e.compressed, e.stretched), least = all_lanes(1e-9f);
            const Vec4 size = error / (select(l < least, least, l) * stiff);
            for (int lane = 0; lane < kLanes; ++lane) {
                const Vec4 step = d[lane] * size[lane];
                x[size_t(e.i[lane])] -= step * e.mass_i[lane];
                x[size_t(e.j[lane])] += step * e.mass_j[lane];
            }
        }
    }

    // The quadratic model of Bergou et al. 2006: the curvature vector's part along the hinge's normal returns to that at rest.
    void bend(std::vector<Vec4>& x) const {
        const Vec4 zero = all_lanes(0), flat = all_lanes(1e-12f);
        for (const Hinges& hinge : hinges_) {
            Soa at[4];
            for (int j = 0; j < 4; ++j) {
                const int32_t* q = hinge.corner[j];
                at[j] = columns(x[size_t(q[0])], x[size_t(q[1])], x[size_t(q[2])], x[size_t(q[3])]);
            }
            const Soa along = at[1] - at[0];
            const Soa n = cross(along, at[2] - at[0]) + cross(at[3] - at[0], along);
            const Vec4 l = length(n);
            const Mask4 bends = l > flat;
            if (!any(bends)) continue;
            const Soa unit = n * (all_lanes(1) / l);
            Soa curvature = {zero, zero, zero};
            for (int j = 0; j < 4; ++j) curvature = curvature + at[j] * hinge.curvature[j];
            Soa step = unit * ((dot(curvature, unit) - hinge.rest) / hinge.stiff);
            step = {select(bends, step.x, zero), select(bends, step.y, zero), select(bends, step.z, zero)};
            Vec4 own[kLanes];
            rows(step, own);
            for (int lane = 0; lane < kLanes; ++lane)
                for (int j = 0; j < 4; ++j) x[size_t(hinge.corner[j][lane])] -= own[lane] * hinge.moves[j][lane];
        }
    }

    // Ends of edges drag each other along.
    void drag(std::vector<Vec4>& v) const {
        for (const Edges& e : edges_) {
            Vec4 d[kLanes];
            along(v, e, d);
            for (int lane = 0; lane < kLanes; ++lane) {
                d[lane] = d[lane] * e.drags[lane];
                v[size_t(e.i[lane])] -= d[lane] * e.mass_i[lane];
                v[size_t(e.j[lane])] += d[lane] * e.mass_j[lane];
            }
        }
    }

    // From now on any edge may be too long.
    void all_wait() { waiting_.all(edges_.size()); }

    // Edges of a particle that was moved may be too long from now on.
    void moved(size_t i) {
        for (int32_t k = first_edge_[i]; k < first_edge_[i + 1]; ++k) waiting_.add(edge_of_[size_t(k)]);
    }

    // One sweep over the edges that are too long, from what holds the cloth downwards or back; says whether there was none.
    // The ends share the correction by their inverse masses: one that follows its place, whose inverse mass is 0, stays there.
    // Where it is led, the end that hangs deeper takes nine tenths: a taut sheet then needs few sweeps (Mueller et al. 2012).
    // Where it slides, free ends count alike and an end that follows its place moves half as much. `over` times the correction: rings shrink by little a sweep, and an edge that
    // comes out too short is no harm.
    bool limit(std::vector<Vec4>& x, bool back, Sharing sharing, float over) {
        bool within = true;
        waiting_.walk(back, [&](int32_t batch) {
            const Edges& e = edges_[size_t(batch)];
            Vec4 d[kLanes];
            along(x, e, d);
            const Soa way = columns(d[0], d[1], d[2], d[3]);
            const Vec4 squared = dot(way, way);
            const Mask4 longer = ~(squared <= e.most_squared);
            if (!any(longer)) return;
            within = false;
            for (int lane = 0; lane < kLanes; ++lane) {
                if (!longer[lane]) continue;
                const size_t i = size_t(e.i[lane]), j = size_t(e.j[lane]);
                float a = e.mass_i[lane], b = e.mass_j[lane];
                if (sharing == kSliding) {
                    a = a > 0 ? 1.0f : kGives, b = b > 0 ? 1.0f : kGives;
                } else if (sharing == kLedDown && a > 0 && b > 0) {
                    const bool deeper = m_.tether[i] > m_.tether[j];
                    a = deeper ? 0.9f : 0.1f, b = 1.0f - a;
                }
                const float l = std::sqrt(squared[lane]);
                const Vec4 step = d[lane] * (over * (l - e.most[lane]) / (l * (a + b)));
                x[i] -= step * a;
                x[j] += step * b;
                moved(i), moved(j);
            }
        });
        return within;
    }

private:
    static constexpr float kGives = 0.5f;  // inverse mass of an end that follows its place, where it slides; others have 1

    // Four edges or hinges that share no particle, a lane each.
    struct Edges {
        int32_t i[kLanes], j[kLanes];
        Vec4 most_squared, most;  // metres that each may be long
        Vec4 mass_i, mass_j;      // inverse masses
        Vec4 length, stretched, compressed;  // at rest; what resists it where it is longer, where it is shorter
        Vec4 drags;               // of the ends' difference of velocities over their masses
    };
    struct Hinges {
        int32_t corner[4][kLanes];
        Vec4 curvature[4], moves[4];  // weights in the curvature vector, times the inverse masses
        Vec4 rest, stiff;
    };

    // From the second end of four edges to the first.
    static void along(const std::vector<Vec4>& x, const Edges& e, Vec4* d) {
        for (int lane = 0; lane < kLanes; ++lane) d[lane] = x[size_t(e.i[lane])] - x[size_t(e.j[lane])];
    }

    float w(int64_t i) const { return m_.inverse_mass[i]; }

    const Model& m_;
    std::vector<Edges> edges_;
    std::vector<int32_t> first_edge_, edge_of_;  // of particles: where theirs begin among the batches of edges
    Waiting waiting_;                            // batches of edges that may be too long
    std::vector<Hinges> hinges_;
};

}  // namespace smplxpp
