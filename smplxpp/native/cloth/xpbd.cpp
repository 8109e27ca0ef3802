// Extended position-based dynamics of cloth (Macklin et al. 2016) with small steps (Macklin et al. 2019): one correction a
// substep of edges, hinges, springs, tethers and contacts, in the order of their arrays (Gauss-Seidel), on one thread.
//
// Small cloth in float: about 800 particles a garment, a thousand substeps a second. Nothing here depends on the time of
// day, on threads or, being built without contraction, on the CPU: the same bits everywhere.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "cloth/surface.hpp"
#include "cloth/vec3.hpp"
#include "common/status.hpp"

namespace {

using smplxpp::Contact;
using smplxpp::Grid;
using smplxpp::Surface;
using smplxpp::Vec3;

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
    const int32_t* collider_face;      // 3 d
    const float* margin;               // c: metres that cloth keeps from it
    const float* deepest;              // c: metres; deeper cloth is on the other side
};

struct Forces {
    double gravity, drag, normal_drag, inner_friction, friction, own_margin, most_speed;
};

// Four moments of the places and of the collider: the last one, this one's start and end, the next one.
struct Moments {
    const float *place[4], *collider[4];
};

// Catmull and Rom's curve through the moments; t in [0, 1] from the second to the third.
void at_time(const float* const* moments, int64_t count, float t, Vec3* out) {
    const float t2 = t * t, t3 = t2 * t;
    const float a = -0.5f * t3 + t2 - 0.5f * t, b = 1.5f * t3 - 2.5f * t2 + 1.0f;
    const float c = -1.5f * t3 + 2.0f * t2 + 0.5f * t, d = 0.5f * t3 - 0.5f * t2;
    for (int64_t i = 0; i < 3 * count; ++i)
        (&out->x)[i] = a * moments[0][i] + b * moments[1][i] + c * moments[2][i] + d * moments[3][i];
}

class Solver {
public:
    Solver(const Model& m, const Forces& f, Vec3* position, Vec3* velocity)
        : m_(m), f_(f), x_(position), v_(velocity), n_(size_t(m.particles)), before_(n_), place_(n_), normal_(n_),
          skin_(size_t(m.collider_vertices)), skin_before_(skin_.size()),
          surface_(m.collider_vertices, m.collider_face, m.collider_faces), contact_(n_, Contact{-1, {0, 0, 0}}) {}

    void advance(const Moments& moments, float seconds, int32_t substeps, int32_t contacts_every) {
        const float h = seconds / float(substeps);
        at_time(moments.collider, m_.collider_vertices, 0.0f, skin_.data());
        for (int32_t s = 0; s < substeps; ++s) {
            const float t = float(s + 1) / float(substeps);
            skin_before_.swap(skin_);
            at_time(moments.place, m_.particles, t, place_.data());
            at_time(moments.collider, m_.collider_vertices, t, skin_.data());
            const bool looks = s % contacts_every == 0;
            if (looks || f_.normal_drag > 0) smplxpp::normals(x_, m_.face, m_.faces, normal_);
            move(h);
            if (looks) find_contacts();
            if (looks && f_.own_margin > 0) find_pairs();
            stretch(h);
            bend(h);
            if (m_.spring) pull(h);
            hold();
            if (f_.own_margin > 0) part();
            touch();
            finish(h);
        }
    }

private:
    float w(int64_t i) const { return m_.inverse_mass[i]; }

    // Gravity and air, then on by the velocity.
    void move(float h) {
        const float drag = 1.0f / (1.0f + float(f_.drag) * h), fall = float(f_.gravity) * h;
        const float across = 1.0f - 1.0f / (1.0f + float(f_.normal_drag) * h);
        for (size_t i = 0; i < n_; ++i) {
            before_[i] = x_[i];
            if (w(int64_t(i)) == 0) {
                x_[i] = place_[i];
                continue;
            }
            Vec3 v = v_[i];
            if (across > 0) v = v - normal_[i] * (dot(v, normal_[i]) * across);
            v.y -= fall;
            x_[i] = x_[i] + v * (drag * h);
        }
    }

    void stretch(float h) {
        const float over = 1.0f / (h * h);
        for (int64_t k = 0; k < m_.edges; ++k) {
            const int32_t i = m_.edge[2 * k], j = m_.edge[2 * k + 1];
            const Vec3 d = x_[i] - x_[j];
            const float l = length(d), error = l - m_.length[k];
            const float soft = (error < 0 ? m_.compress : m_.stretch)[k] * over;
            const Vec3 step = d * (error / (std::max(l, 1e-9f) * std::max(w(i) + w(j) + soft, 1e-20f)));
            x_[i] = x_[i] - step * w(i);
            x_[j] = x_[j] + step * w(j);
        }
    }

    // The quadratic model of Bergou et al. 2006: the curvature vector's part along the hinge's normal returns to that at rest.
    void bend(float h) {
        const float over = 1.0f / (h * h);
        for (int64_t k = 0; k < m_.hinges; ++k) {
            const int32_t* q = m_.hinge + 4 * k;
            const float* c = m_.curvature + 4 * k;
            const Vec3 along = x_[q[1]] - x_[q[0]];
            const Vec3 n = cross(along, x_[q[2]] - x_[q[0]]) + cross(x_[q[3]] - x_[q[0]], along);
            const float l = length(n);
            if (!(l > 1e-12f)) continue;
            const Vec3 unit = n * (1.0f / l);
            Vec3 curvature = {0, 0, 0};
            float weight = m_.bend[k] * over;
            for (int j = 0; j < 4; ++j) {
                curvature = curvature + x_[q[j]] * c[j];
                weight += w(q[j]) * c[j] * c[j];
            }
            const Vec3 step = unit * ((dot(curvature, unit) - m_.rest_curvature[k]) / std::max(weight, 1e-20f));
            for (int j = 0; j < 4; ++j) x_[q[j]] = x_[q[j]] - step * (w(q[j]) * c[j]);
        }
    }

    void pull(float h) {
        const float over = 1.0f / (h * h);
        for (size_t i = 0; i < n_; ++i) {
            const float mass = w(int64_t(i)), soft = m_.spring[i] * over;
            if (mass > 0 && std::isfinite(soft)) x_[i] = x_[i] + (place_[i] - x_[i]) * (mass / (mass + soft));
        }
    }

    // Long-range attachments (Kim et al. 2012).
    void hold() {
        for (size_t i = 0; i < n_; ++i) {
            const int32_t to = m_.anchor[i];
            if (to < 0 || w(int64_t(i)) == 0) continue;
            const Vec3 d = x_[i] - x_[to];
            const float squared = dot(d, d), most = m_.tether[i];
            if (squared > most * most) x_[i] = x_[to] + d * (most / std::sqrt(squared));
        }
    }

    void find_contacts() {
        surface_.look(skin_.data());
        for (size_t i = 0; i < n_; ++i)
            contact_[i] = w(int64_t(i)) == 0 ? Contact{-1, {0, 0, 0}} : surface_.find(x_[i], normal_[i]);
    }

    // Out of the collider along its smooth normal; Coulomb's friction against its own motion.
    void touch() {
        const float friction = float(f_.friction);
        for (size_t i = 0; i < n_; ++i) {
            if (contact_[i].face < 0 || w(int64_t(i)) == 0) continue;
            const int32_t* q = m_.collider_face + 3 * int64_t(contact_[i].face);
            const float* b = contact_[i].weight;
            Vec3 p = {0, 0, 0}, was = {0, 0, 0}, n = {0, 0, 0};
            float margin = 0, deepest = 0;
            for (int j = 0; j < 3; ++j) {
                p = p + skin_[size_t(q[j])] * b[j];
                was = was + skin_before_[size_t(q[j])] * b[j];
                n = n + surface_.normal(q[j]) * b[j];
                margin += m_.margin[q[j]] * b[j];
                deepest += m_.deepest[q[j]] * b[j];
            }
            const float l = length(n);
            if (l < 1e-6f) continue;
            n = n * (1.0f / l);
            const float height = dot(x_[i] - p, n), depth = margin - height;
            if (depth <= 0 || height < -deepest) continue;
            x_[i] = x_[i] + n * depth;
            Vec3 slip = (x_[i] - before_[i]) - (p - was);
            slip = slip - n * dot(slip, n);
            const float way = length(slip);
            if (way > 1e-9f) x_[i] = x_[i] - slip * std::min(1.0f, friction * depth / way);
        }
    }

    // Particles that came nearer than the margin, their own neighbours aside.
    void find_pairs() {
        const float reach = 1.5f * float(f_.own_margin);
        pairs_.clear();
        own_.fill(x_, m_.particles, reach);
        for (int32_t i = 0; i < m_.particles; ++i)
            own_.around(x_[i], [&](int32_t j) {
                if (j <= i) return;
                const Vec3 d = x_[i] - x_[j];
                if (dot(d, d) < reach * reach && !neighbours(i, j)) pairs_.push_back({i, j});
            });
    }

    bool neighbours(int32_t i, int32_t j) {
        if (linked_.empty() && m_.edges) {
            for (int64_t k = 0; k < m_.edges; ++k)
                linked_.push_back(link(m_.edge[2 * k], m_.edge[2 * k + 1]));
            std::sort(linked_.begin(), linked_.end());
        }
        return std::binary_search(linked_.begin(), linked_.end(), link(i, j));
    }
    static int64_t link(int32_t i, int32_t j) { return (int64_t(std::min(i, j)) << 32) | std::max(i, j); }

    void part() {
        const float margin = float(f_.own_margin);
        for (const auto& [i, j] : pairs_) {
            const float masses = w(i) + w(j);
            const Vec3 d = x_[i] - x_[j];
            const float l = length(d);
            if (masses == 0 || l >= margin || l < 1e-7f) continue;
            const Vec3 step = d * ((margin - l) / (masses * l));
            x_[i] = x_[i] + step * w(i);
            x_[j] = x_[j] - step * w(j);
        }
    }

    // Velocities of what was moved; neighbours drag each other along.
    void finish(float h) {
        const float over = 1.0f / h, most = float(f_.most_speed);
        for (size_t i = 0; i < n_; ++i) {
            v_[i] = (x_[i] - before_[i]) * over;
            const float speed = length(v_[i]);
            if (speed > most) v_[i] = v_[i] * (most / speed);
        }
        const float share = std::min(0.45f, float(f_.inner_friction) * h);
        if (share <= 0) return;
        for (int64_t k = 0; k < m_.edges; ++k) {
            const int32_t i = m_.edge[2 * k], j = m_.edge[2 * k + 1];
            const float masses = w(i) + w(j);
            if (masses == 0) continue;
            const Vec3 d = (v_[i] - v_[j]) * (share / masses);
            v_[i] = v_[i] - d * w(i);
            v_[j] = v_[j] + d * w(j);
        }
    }

    struct Pair {
        int32_t i, j;
    };
    const Model& m_;
    const Forces& f_;
    Vec3 *x_, *v_;
    size_t n_;
    std::vector<Vec3> before_, place_, normal_, skin_, skin_before_;
    Surface surface_;
    std::vector<Contact> contact_;
    std::vector<Pair> pairs_;
    std::vector<int64_t> linked_;
    Grid own_;
};

void check(const Model& m) {
    using smplxpp::check_indices;
    check_indices(m.face, 3 * m.faces, m.particles);
    check_indices(m.edge, 2 * m.edges, m.particles);
    check_indices(m.hinge, 4 * m.hinges, m.particles);
    check_indices(m.collider_face, 3 * m.collider_faces, m.collider_vertices);
    for (int64_t i = 0; i < m.particles; ++i)
        if (m.anchor[i] < -1 || m.anchor[i] >= m.particles) smplxpp::throw_out_of_range("anchor");
}

}  // namespace

// Moves n particles (3 n metres, metres a second, in place) on by `seconds`.
SMPLXPP_EXPORT int32_t smplxpp_cloth_advance(const Model* model, const Forces* forces, const Moments* moments, float seconds,
                                             int32_t substeps, int32_t contacts_every, float* position, float* velocity) {
    return smplxpp::guarded([&] {
        check(*model);
        if (substeps < 1 || contacts_every < 1) smplxpp::throw_out_of_range("substeps");
        Solver(*model, *forces, (Vec3*)position, (Vec3*)velocity).advance(*moments, seconds, substeps, contacts_every);
    });
}
