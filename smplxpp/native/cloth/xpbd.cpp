// Extended position-based dynamics of cloth (Macklin et al. 2016) with small steps (Macklin et al. 2019): one correction a
// substep of edges, hinges, springs, tethers and contacts, in the order of their arrays (Gauss-Seidel), on one thread; then
// strain limiting as a hard bound (Provot 1995; Thomaszewski et al. 2009; Wang et al. 2010), at the end of the span until no
// edge is longer than it may be: first together with the contacts, then without those that cannot be kept as well.
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
using smplxpp::cross;
using smplxpp::dot;
using smplxpp::Grid;
using smplxpp::length;
using smplxpp::Surface;
using smplxpp::narrowed;
using smplxpp::Vec3;
using smplxpp::Vec4;
using smplxpp::widened;

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
    double most_stretch;  // of an edge, over its length at rest
    int64_t* report;      // 2: contacts that were let go, particles that follow their places and were moved from these
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
        : m_(m), f_(f), position_(position), velocity_(velocity), n_(size_t(m.particles)), x_(n_), v_(n_), before_(n_),
          place_(n_), normal_(n_),
          skin_(size_t(m.collider_vertices)), skin_before_(skin_.size()),
          surface_(m.collider_vertices, m.collider_face, m.collider_faces), contact_(2 * n_, Contact{-1, {0, 0, 0}}) {}

    void advance(const Moments& moments, float seconds, int32_t substeps, int32_t contacts_every) {
        substeps = std::max(substeps, std::min(kShorter * substeps, needed(moments, seconds)));
        const float h = seconds / float(substeps);
        prepare(h);
        std::transform(position_, position_ + n_, x_.begin(), widened);
        std::transform(velocity_, velocity_ + n_, v_.begin(), widened);
        at_time(moments.collider, m_.collider_vertices, 0.0f, skin_.data());
        for (int32_t s = 0; s < substeps; ++s) {
            const float t = float(s + 1) / float(substeps);
            skin_before_.swap(skin_);
            at_time(moments.place, m_.particles, t, place_.data());
            at_time(moments.collider, m_.collider_vertices, t, skin_.data());
            const bool looks = s % contacts_every == 0;
            if (looks || f_.normal_drag > 0) smplxpp::normals(x_.data(), m_.face, m_.faces, normal_);
            move(h);
            if (looks) find_contacts();
            if (looks && f_.own_margin > 0) find_pairs();
            stretch();
            bend();
            if (m_.spring) pull(h);
            hold();
            if (f_.own_margin > 0) part();
            touch();
            for (int32_t k = 0; k < kSweeps && !limit(k % 2 == 1, kShared, 1.0f); ++k) {}
            finish(h);
        }
        bound();
        std::transform(x_.begin(), x_.end(), position_, narrowed);
        std::transform(v_.begin(), v_.end(), velocity_, narrowed);
    }

private:
    static constexpr int32_t kShorter = 3;                       // times as many substeps at most as were asked for
    static constexpr int32_t kSweeps = 6;                        // over edges that are too long, a substep
    static constexpr int32_t kLed = 8, kFree = 16, kSlide = 48;  // sweeps of the bound after which the deeper end is moved, ...
    static constexpr int32_t kBound = 200;                       // ... contacts are let go, what follows its place slides; all
    static constexpr float kGives = 0.5f;                        // inverse mass that it has then, where others have 1
    static constexpr float kOver = 1.8f;                         // times the correction from the sweeps without contacts on
    static constexpr float kLetGo = 3e-3f;                       // metres within the margin from which a contact was let go
    static constexpr float kOut = 4e-3f;                         // metres a substep at which deep cloth comes out

    float w(int64_t i) const { return m_.inverse_mass[i]; }

    // Substeps in which neither skin nor cloth moves by more than the cloth's thickness, against the mean motion of the places:
    // a person who runs takes all along. What is not finite asks for none.
    int32_t needed(const Moments& moments, float seconds) const {
        float thickness = 0;
        for (int64_t i = 0; i < m_.collider_vertices; ++i) thickness = std::max(thickness, m_.margin[i]);
        if (!(thickness > 0) || n_ == 0) return 0;
        const auto way = [](const float* from, const float* to, size_t i) {
            return Vec3{to[3 * i] - from[3 * i], to[3 * i + 1] - from[3 * i + 1], to[3 * i + 2] - from[3 * i + 2]};
        };
        Vec3 mean = {0, 0, 0};
        for (size_t i = 0; i < n_; ++i) mean = mean + way(moments.place[1], moments.place[2], i);
        mean = mean * (1.0f / float(n_));
        float most = 0;
        for (size_t i = 0; i < n_; ++i) {
            const Vec3 d = velocity_[i] * seconds - mean;
            most = std::max(most, dot(d, d));
        }
        for (size_t i = 0; i < skin_.size(); ++i) {
            const Vec3 d = way(moments.collider[1], moments.collider[2], i) - mean;
            most = std::max(most, dot(d, d));
        }
        const float substeps = std::ceil(std::sqrt(most) / thickness);
        return substeps < 1e6f ? int32_t(substeps) : 0;
    }

    // Gravity and air, then on by the velocity.
    void move(float h) {
        const float drag = 1.0f / (1.0f + float(f_.drag) * h), fall = float(f_.gravity) * h;
        const float across = 1.0f - 1.0f / (1.0f + float(f_.normal_drag) * h);
        for (size_t i = 0; i < n_; ++i) {
            before_[i] = x_[i];
            if (w(int64_t(i)) == 0) {
                x_[i] = widened(place_[i]);
                continue;
            }
            Vec4 v = v_[i];
            if (across > 0) v = v - normal_[i] * (dot(v, normal_[i]) * across);
            x_[i] = x_[i] + (v - Vec4{0, fall, 0, 0}) * (drag * h);
        }
    }

    // What of edges and hinges is the same in all substeps, in the order in which those read it.
    void prepare(float h) {
        const float over = 1.0f / (h * h), share = std::min(0.45f, float(f_.inner_friction) * h);
        edges_.resize(size_t(m_.edges));
        for (int64_t k = 0; k < m_.edges; ++k) {
            const int32_t i = m_.edge[2 * k], j = m_.edge[2 * k + 1];
            const float masses = w(i) + w(j);
            const auto stiff = [&](const float* soft) { return std::max(masses + soft[k] * over, 1e-20f); };
            const float drags = masses == 0 || share <= 0 ? 0.0f : share / masses;
            const float most = float(f_.most_stretch) * m_.length[k];
            edges_[size_t(k)] = {i, j, w(i), w(j), m_.length[k], stiff(m_.stretch), stiff(m_.compress), drags, most, most * most};
        }
        hinges_.resize(size_t(m_.hinges));
        for (int64_t k = 0; k < m_.hinges; ++k) {
            Hinge& hinge = hinges_[size_t(k)];
            hinge.rest = m_.rest_curvature[k], hinge.stiff = m_.bend[k] * over;
            for (int j = 0; j < 4; ++j) {
                const float c = m_.curvature[4 * k + j], mass = w(hinge.corner[j] = m_.hinge[4 * k + j]);
                hinge.curvature[j] = c, hinge.moves[j] = mass * c;
                hinge.stiff += mass * c * c;
            }
            hinge.stiff = std::max(hinge.stiff, 1e-20f);
        }
    }

    void stretch() {
        for (const Edge& e : edges_) {
            const Vec4 d = x_[size_t(e.i)] - x_[size_t(e.j)];
            const float l = length(d), error = l - e.length;
            const Vec4 step = d * (error / (std::max(l, 1e-9f) * (error < 0 ? e.compressed : e.stretched)));
            x_[size_t(e.i)] -= step * e.mass_i;
            x_[size_t(e.j)] += step * e.mass_j;
        }
    }

    // The quadratic model of Bergou et al. 2006: the curvature vector's part along the hinge's normal returns to that at rest.
    void bend() {
        for (const Hinge& hinge : hinges_) {
            Vec4* const at[4] = {&x_[size_t(hinge.corner[0])], &x_[size_t(hinge.corner[1])], &x_[size_t(hinge.corner[2])],
                                 &x_[size_t(hinge.corner[3])]};
            const Vec4 along = *at[1] - *at[0];
            const Vec4 n = cross(along, *at[2] - *at[0]) + cross(*at[3] - *at[0], along);
            const float l = length(n);
            if (!(l > 1e-12f)) continue;
            const Vec4 unit = n * (1.0f / l);
            Vec4 curvature = {0, 0, 0, 0};
            for (int j = 0; j < 4; ++j) curvature += *at[j] * hinge.curvature[j];
            const Vec4 step = unit * ((dot(curvature, unit) - hinge.rest) / hinge.stiff);
            for (int j = 0; j < 4; ++j) *at[j] -= step * hinge.moves[j];
        }
    }

    // One sweep over the edges that are too long, from what holds the cloth downwards or back; says whether there was none.
    // The ends share the correction by their inverse masses, of which one that follows its place has `pins` of the other end's.
    // Where it is led, the end that hangs deeper takes nine tenths: a taut sheet then needs few sweeps (Mueller et al. 2012).
    // What slides counts all particles alike. `over` times the correction: rings shrink by little a sweep, and an edge that
    // comes out too short is no harm.
    enum Sharing { kShared, kLedDown, kSliding };
    bool limit(bool back, Sharing sharing, float over) {
        bool within = true;
        const size_t count = edges_.size();
        for (size_t k = 0; k < count; ++k) {
            const Edge& e = edges_[back ? count - 1 - k : k];
            const Vec4 d = x_[size_t(e.i)] - x_[size_t(e.j)];
            const float squared = dot(d, d);
            if (squared <= e.most_squared) continue;
            within = false;
            float a = e.mass_i, b = e.mass_j;
            if (sharing == kSliding) {
                a = a > 0 ? 1.0f : kGives, b = b > 0 ? 1.0f : kGives;
            } else if (sharing == kLedDown && a > 0 && b > 0) {
                const bool deeper = m_.tether[e.i] > m_.tether[e.j];
                a = deeper ? 0.9f : 0.1f, b = 1.0f - a;
            }
            const float l = std::sqrt(squared);
            const Vec4 step = d * (over * (l - e.most) / (l * (a + b)));
            x_[size_t(e.i)] -= step * a;
            x_[size_t(e.j)] += step * b;
        }
        return within;
    }

    // The hard bound at the end of a span. Limits of lengths are convex, so that sweeps over them converge. What the body pushes
    // and what two of its limbs pinch may leave no place within all of them: contacts give way, then what follows its place
    // slides along the body, which alone has a solution always. Velocities are not those of these corrections.
    void bound() {
        int32_t sweeps = 0;
        for (; sweeps < kBound; ++sweeps) {
            const Sharing sharing = sweeps >= kSlide ? kSliding : sweeps >= kLed && sweeps < kFree ? kLedDown : kShared;
            if (limit(sweeps % 2 == 1, sharing, sweeps >= kFree ? kOver : 1.0f)) break;
            if (sweeps < kFree) push();
        }
        if (sweeps <= kFree || !f_.report) return;
        for (size_t i = 0; i < n_; ++i) {
            Place at;
            if (w(int64_t(i)) == 0)
                f_.report[1] += length(x_[i] - widened(place_[i])) > 1e-3f;
            else if (place_on(i, at) && at.margin - dot(narrowed(x_[i]) - at.point, at.normal) > kLetGo)
                ++f_.report[0];
        }
    }

    void pull(float h) {
        const float over = 1.0f / (h * h);
        for (size_t i = 0; i < n_; ++i) {
            const float mass = w(int64_t(i)), soft = m_.spring[i] * over;
            if (mass > 0 && std::isfinite(soft)) x_[i] += (widened(place_[i]) - x_[i]) * (mass / (mass + soft));
        }
    }

    // Long-range attachments (Kim et al. 2012).
    void hold() {
        for (size_t i = 0; i < n_; ++i) {
            const int32_t to = m_.anchor[i];
            if (to < 0 || w(int64_t(i)) == 0) continue;
            const Vec4 d = x_[i] - x_[size_t(to)];
            const float squared = dot(d, d), most = m_.tether[i];
            if (squared > most * most) x_[i] = x_[size_t(to)] + d * (most / std::sqrt(squared));
        }
    }

    void find_contacts() {
        surface_.look(skin_.data());
        for (size_t i = 0; i < n_; ++i) {
            Contact &first = contact_[i], &second = contact_[n_ + i];
            first = second = Contact{-1, {0, 0, 0}};
            if (w(int64_t(i)) == 0) continue;
            const Vec3 p = narrowed(x_[i]), normal = narrowed(normal_[i]);
            const int32_t near = surface_.nearest(p, normal);
            first = surface_.find_from(near, p, normal);
            // A lap, an armpit, a bent knee: cloth lies between two sides of the body that come together.
            if (near >= 0) second = surface_.find_from(surface_.nearest(p, normal, surface_.normal(near)), p, normal);
        }
    }

    // The place of the collider that a particle touches, now and before the substep.
    struct Place {
        Vec3 point, was, normal;
        float margin, deepest;
    };
    bool place_on(size_t k, Place& at) const {
        if (contact_[k].face < 0) return false;
        const int32_t* q = m_.collider_face + 3 * int64_t(contact_[k].face);
        const float* b = contact_[k].weight;
        at = {{0, 0, 0}, {0, 0, 0}, {0, 0, 0}, 0, 0};
        for (int j = 0; j < 3; ++j) {
            at.point = at.point + skin_[size_t(q[j])] * b[j];
            at.was = at.was + skin_before_[size_t(q[j])] * b[j];
            at.normal = at.normal + surface_.normal(q[j]) * b[j];
            at.margin += m_.margin[q[j]] * b[j];
            at.deepest += m_.deepest[q[j]] * b[j];
        }
        const float l = length(at.normal);
        if (l < 1e-6f) return false;
        at.normal = at.normal * (1.0f / l);
        return true;
    }

    // Out of the collider along its smooth normal; Coulomb's friction against its own motion. What lies deep comes out no faster
    // than `kOut` and the collider: at once it would fly.
    void touch() {
        const float friction = float(f_.friction);
        Place at;
        for (size_t k = 0; k < 2 * n_; ++k) {
            if (!place_on(k, at)) continue;
            const size_t i = k % n_;
            Vec3 x = narrowed(x_[i]);
            const float height = dot(x - at.point, at.normal);
            if (at.margin - height <= 0 || height < -at.deepest) continue;
            const float depth = std::min(at.margin - height, kOut + std::max(0.0f, dot(at.point - at.was, at.normal)) +
                std::max(0.0f, dot(narrowed(before_[i]) - x, at.normal)));
            x = x + at.normal * depth;
            Vec3 slip = (x - narrowed(before_[i])) - (at.point - at.was);
            slip = slip - at.normal * dot(slip, at.normal);
            const float way = length(slip);
            if (way > 1e-9f) x = x - slip * std::min(1.0f, friction * depth / way);
            x_[i] = widened(x);
        }
    }

    // The same without friction, between sweeps of the bound.
    void push() {
        Place at;
        for (size_t k = 0; k < 2 * n_; ++k) {
            if (!place_on(k, at)) continue;
            const size_t i = k % n_;
            const float height = dot(narrowed(x_[i]) - at.point, at.normal);
            if (at.margin - height > 0 && height > -at.deepest)
                x_[i] = x_[i] + widened(at.normal * std::min(kOut, at.margin - height));
        }
    }

    // Particles that came nearer than the margin, their own neighbours aside.
    void find_pairs() {
        const float reach = 1.5f * float(f_.own_margin);
        pairs_.clear();
        std::transform(x_.begin(), x_.end(), position_, narrowed);
        own_.fill(position_, m_.particles, reach);
        for (int32_t i = 0; i < m_.particles; ++i)
            own_.around(position_[i], [&](int32_t j) {
                if (j <= i) return;
                const Vec3 d = position_[i] - position_[j];
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
            const Vec4 d = x_[size_t(i)] - x_[size_t(j)];
            const float l = length(d);
            if (masses == 0 || l >= margin || l < 1e-7f) continue;
            const Vec4 step = d * ((margin - l) / (masses * l));
            x_[size_t(i)] += step * w(i);
            x_[size_t(j)] -= step * w(j);
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
        for (const Edge& e : edges_) {
            if (e.drags == 0) continue;
            const Vec4 d = (v_[size_t(e.i)] - v_[size_t(e.j)]) * e.drags;
            v_[size_t(e.i)] -= d * e.mass_i;
            v_[size_t(e.j)] += d * e.mass_j;
        }
    }

    struct Edge {
        int32_t i, j;
        float mass_i, mass_j;  // inverse masses
        float length, stretched, compressed;  // at rest; what resists it where it is longer, where it is shorter
        float drags;           // of the ends' difference of velocities over their masses
        float most, most_squared;  // metres that it may be long
    };
    struct Hinge {
        int32_t corner[4];
        float curvature[4], moves[4];  // weights in the curvature vector, times the inverse masses
        float rest, stiff;
    };

    struct Pair {
        int32_t i, j;
    };
    const Model& m_;
    const Forces& f_;
    Vec3 *position_, *velocity_;
    size_t n_;
    std::vector<Vec4> x_, v_, before_;
    std::vector<Vec3> place_;
    std::vector<Vec4> normal_;
    std::vector<Vec3> skin_, skin_before_;
    Surface surface_;
    std::vector<Edge> edges_;
    std::vector<Hinge> hinges_;
    std::vector<Contact> contact_;  // 2 n: the nearest place of each particle, then that on the other side of a fold
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
