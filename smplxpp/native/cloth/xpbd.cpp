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

#include "cloth/constraints.hpp"
#include "cloth/surface.hpp"
#include "cloth/vec3.hpp"
#include "common/status.hpp"

namespace {

using smplxpp::Constraints;
using smplxpp::Contact;
using smplxpp::dot;
using smplxpp::Forces;
using smplxpp::Grid;
using smplxpp::length;
using smplxpp::Model;
using smplxpp::narrowed;
using smplxpp::Surface;
using smplxpp::Vec3;
using smplxpp::Vec4;
using smplxpp::widened;

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
        : m_(m), f_(f), position_(position), velocity_(velocity), n_(size_t(m.particles)), x_(n_ + 1), v_(n_ + 1), before_(n_),
          place_(n_), normal_(n_),
          skin_(size_t(m.collider_vertices)), skin_before_(skin_.size()),
          surface_(m.collider_vertices, m.collider_face, m.collider_faces) {}

    void advance(const Moments& moments, float seconds, int32_t substeps, int32_t contacts_every) {
        substeps = std::max(substeps, std::min(kShorter * substeps, needed(moments, seconds)));
        const float h = seconds / float(substeps);
        Constraints constraints(m_, f_, h);
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
            constraints.stretch(x_);
            constraints.bend(x_);
            if (m_.spring) pull(h);
            hold();
            if (f_.own_margin > 0) part();
            touch();
            constraints.all_wait();
            for (int32_t k = 0; k < kSweeps && !constraints.limit(x_, k % 2 == 1, smplxpp::kShared, 1.0f); ++k) {}
            finish(h);
            constraints.drag(v_);
        }
        bound(constraints);
        std::transform(x_.begin(), x_.end() - 1, position_, narrowed);
        std::transform(v_.begin(), v_.end() - 1, velocity_, narrowed);
    }

private:
    static constexpr int32_t kShorter = 3;                       // times as many substeps at most as were asked for
    static constexpr int32_t kSweeps = 6;                        // over edges that are too long, a substep
    static constexpr int32_t kLed = 8, kFree = 16, kSlide = 48;  // sweeps of the bound after which the deeper end is moved, ...
    static constexpr int32_t kBound = 200;                       // ... contacts are let go, what follows its place slides; all
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

    // The hard bound at the end of a span. Limits of lengths are convex, so that sweeps over them converge. What the body pushes
    // and what two of its limbs pinch may leave no place within all of them: contacts give way, then what follows its place
    // slides along the body, which alone has a solution always. Velocities are not those of these corrections.
    void bound(Constraints& constraints) {
        constraints.all_wait();
        int32_t sweeps = 0;
        for (; sweeps < kBound; ++sweeps) {
            const auto sharing = sweeps >= kSlide               ? smplxpp::kSliding
                                 : sweeps >= kLed && sweeps < kFree ? smplxpp::kLedDown
                                                                    : smplxpp::kShared;
            if (constraints.limit(x_, sweeps % 2 == 1, sharing, sweeps >= kFree ? kOver : 1.0f)) break;
            if (sweeps < kFree) push(constraints);
        }
        if (sweeps <= kFree || !f_.report) return;
        for (size_t k = 0; k < sides_; ++k) {
            const Touch& at = touches_[k];
            f_.report[0] += at.margin - dot(narrowed(x_[at.particle]) - place_on(skin_, at), at.normal) > kLetGo;
        }
        for (size_t i = 0; i < n_; ++i)
            f_.report[1] += w(int64_t(i)) == 0 && length(x_[i] - widened(place_[i])) > 1e-3f;
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
        touches_.clear(), folds_.clear();
        for (size_t i = 0; i < n_; ++i) {
            if (w(int64_t(i)) == 0) continue;
            const Vec3 p = narrowed(x_[i]), normal = narrowed(normal_[i]);
            const int32_t near = surface_.nearest(p, normal);
            if (near < 0) continue;
            keep(i, surface_.find_from(near, p, normal), touches_);
            // A lap, an armpit, a bent knee: cloth lies between two sides of the body that come together.
            keep(i, surface_.find_from(surface_.nearest_against(surface_.normal(near), p, normal), p, normal), folds_);
        }
        sides_ = touches_.size();
        touches_.insert(touches_.end(), folds_.begin(), folds_.end());
    }

    // A place of the collider that a particle touches. Corners and weights stay until contacts are looked for again, and so do
    // the smooth normal there, the margin and the depth from which cloth is on the other side.
    struct Touch {
        size_t particle;
        int32_t corner[3];
        float weight[3];
        Vec3 normal;
        float margin, deepest;
    };
    void keep(size_t particle, const Contact& contact, std::vector<Touch>& touches) {
        if (contact.face < 0) return;
        Touch touch = {particle, {}, {}, {0, 0, 0}, 0, 0};
        for (int j = 0; j < 3; ++j) {
            const int32_t q = touch.corner[j] = m_.collider_face[3 * int64_t(contact.face) + j];
            const float b = touch.weight[j] = contact.weight[j];
            touch.normal = touch.normal + surface_.normal(q) * b;
            touch.margin += m_.margin[q] * b;
            touch.deepest += m_.deepest[q] * b;
        }
        const float l = length(touch.normal);
        if (l < 1e-6f) return;
        touch.normal = touch.normal * (1.0f / l);
        touches.push_back(touch);
    }
    static Vec3 place_on(const std::vector<Vec3>& skin, const Touch& touch) {
        Vec3 sum = {0, 0, 0};
        for (int j = 0; j < 3; ++j) sum = sum + skin[size_t(touch.corner[j])] * touch.weight[j];
        return sum;
    }

    // Out of the collider along its smooth normal; Coulomb's friction against its own motion. What lies deep comes out no faster
    // than `kOut` and the collider: at once it would fly.
    void touch() {
        const float friction = float(f_.friction);
        for (const Touch& at : touches_) {
            const size_t i = at.particle;
            Vec3 x = narrowed(x_[i]);
            const Vec3 point = place_on(skin_, at);
            const float height = dot(x - point, at.normal);
            if (at.margin - height <= 0 || height < -at.deepest) continue;
            const Vec3 skin_moved = point - place_on(skin_before_, at);
            const float depth = std::min(at.margin - height, kOut + std::max(0.0f, dot(skin_moved, at.normal)) +
                std::max(0.0f, dot(narrowed(before_[i]) - x, at.normal)));
            x = x + at.normal * depth;
            Vec3 slip = (x - narrowed(before_[i])) - skin_moved;
            slip = slip - at.normal * dot(slip, at.normal);
            const float way = length(slip);
            if (way > 1e-9f) x = x - slip * std::min(1.0f, friction * depth / way);
            x_[i] = widened(x);
        }
    }

    // The same without friction, between sweeps of the bound.
    void push(Constraints& constraints) {
        for (const Touch& at : touches_) {
            const size_t i = at.particle;
            const float height = dot(narrowed(x_[i]) - place_on(skin_, at), at.normal);
            if (at.margin - height <= 0 || height <= -at.deepest) continue;
            x_[i] = x_[i] + widened(at.normal * std::min(kOut, at.margin - height));
            constraints.moved(i);
        }
    }

    // Particles that came nearer than the margin, their own neighbours aside.
    void find_pairs() {
        const float reach = 1.5f * float(f_.own_margin);
        pairs_.clear();
        std::transform(x_.begin(), x_.end() - 1, position_, narrowed);
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

    // Velocities of what was moved.
    void finish(float h) {
        const float over = 1.0f / h, most = float(f_.most_speed);
        for (size_t i = 0; i < n_; ++i) {
            v_[i] = (x_[i] - before_[i]) * over;
            const float speed = length(v_[i]);
            if (speed > most) v_[i] = v_[i] * (most / speed);
        }
    }

    struct Pair {
        int32_t i, j;
    };
    const Model& m_;
    const Forces& f_;
    Vec3 *position_, *velocity_;
    size_t n_;
    std::vector<Vec4> x_, v_;  // n, and one that stays at the origin
    std::vector<Vec4> before_;
    std::vector<Vec3> place_;
    std::vector<Vec4> normal_;
    std::vector<Vec3> skin_, skin_before_;
    Surface surface_;
    // What particles touch: first `sides_` nearest places, then those on the other side of a fold.
    std::vector<Touch> touches_, folds_;
    size_t sides_ = 0;
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
