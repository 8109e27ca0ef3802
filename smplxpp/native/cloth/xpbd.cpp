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
#include <cstring>
#include <vector>

#include "cloth/constraints.hpp"
#include "cloth/pairs.hpp"
#include "cloth/surface.hpp"
#include "cloth/vec3.hpp"
#include "common/status.hpp"

namespace {

using smplxpp::Constraints;
using smplxpp::Contact;
using smplxpp::dot;
using smplxpp::Forces;
using smplxpp::length;
using smplxpp::Mask4;
using smplxpp::Model;
using smplxpp::narrowed;
using smplxpp::Pairs;
using smplxpp::Soa;
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
        : m_(m), f_(f), position_(position), velocity_(velocity), n_(size_t(m.particles)), x_(n_ + 1), v_(n_ + 1), before_(n_ + 1),
          place_(n_), normal_(n_),
          skin_(size_t(m.collider_vertices) + 1), skin_before_(skin_.size()),
          surface_(m.collider_vertices, m.collider_face, m.collider_faces), pairs_(m, float(f.own_margin)) {}

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
            if (looks && f_.own_margin > 0) pairs_.find(x_);
            constraints.stretch(x_);
            constraints.bend(x_);
            if (m_.spring) pull(h);
            hold();
            pairs_.part(x_);
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
        for (size_t i = 0; i < size_t(m_.collider_vertices); ++i) {
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
            const Touches& four = touches_[k];
            const Mask4 deep = four.margin - dot(places(x_, four) - place_on(skin_, four), four.normal) > kLetGo;
            for (int lane = 0; lane < smplxpp::kLanes; ++lane) f_.report[0] -= deep[lane];
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
        int side = smplxpp::kLanes, fold = smplxpp::kLanes;  // the next lane of either
        for (size_t i = 0; i < n_; ++i) {
            if (w(int64_t(i)) == 0) continue;
            const Vec3 p = narrowed(x_[i]), normal = narrowed(normal_[i]);
            const int32_t near = surface_.nearest(p, normal);
            if (near < 0) continue;
            keep(i, surface_.find_from(near, p, normal), touches_, side);
            // A lap, an armpit, a bent knee: cloth lies between two sides of the body that come together.
            keep(i, surface_.find_from(surface_.nearest_against(surface_.normal(near), p, normal), p, normal), folds_, fold);
        }
        sides_ = touches_.size();
        touches_.insert(touches_.end(), folds_.begin(), folds_.end());
    }

    // Places of the collider that four particles touch, a lane each. Corners and weights stay until contacts are looked for again,
    // and so do the smooth normals there, the margins and the depths from which cloth is on the other side. Empty lanes have the
    // particle n and a margin that nothing is within.
    struct Touches {
        int32_t particle[smplxpp::kLanes], corner[3][smplxpp::kLanes];
        Vec4 weight[3];
        Soa normal;
        Vec4 margin, deepest;
    };
    // Puts a contact into the next lane; a particle comes once in the array, so that fours may be corrected at once.
    void keep(size_t particle, const Contact& contact, std::vector<Touches>& touches, int& lane) {
        if (contact.face < 0) return;
        int32_t corner[3];
        Vec3 normal = {0, 0, 0};
        float margin = 0, deepest = 0;
        for (int j = 0; j < 3; ++j) {
            const int32_t q = corner[j] = m_.collider_face[3 * int64_t(contact.face) + j];
            const float b = contact.weight[j];
            normal = normal + surface_.normal(q) * b;
            margin += m_.margin[q] * b;
            deepest += m_.deepest[q] * b;
        }
        const float l = length(normal);
        if (l < 1e-6f) return;
        normal = normal * (1.0f / l);
        if (lane == smplxpp::kLanes) {
            Touches& none = touches.emplace_back();
            std::fill_n(none.particle, lane, int32_t(n_));
            none.margin = smplxpp::all_lanes(-INFINITY), lane = 0;
        }
        Touches& four = touches.back();
        four.particle[lane] = int32_t(particle);
        for (int j = 0; j < 3; ++j) four.corner[j][lane] = corner[j], four.weight[j][lane] = contact.weight[j];
        four.normal.x[lane] = normal.x, four.normal.y[lane] = normal.y, four.normal.z[lane] = normal.z;
        four.margin[lane] = margin, four.deepest[lane] = deepest;
        ++lane;
    }
    // What is not a number passes comparisons that are turned around, and would move the particle of an empty lane.
    static Mask4 taken(const Touches& four) { return four.margin > smplxpp::all_lanes(-INFINITY); }
    static Soa places(const std::vector<Vec4>& x, const Touches& four) {
        const int32_t* q = four.particle;
        return smplxpp::columns(x[size_t(q[0])], x[size_t(q[1])], x[size_t(q[2])], x[size_t(q[3])]);
    }
    // The skin has one vertex more than there are, so that each can be read with the float behind it.
    static Soa place_on(const std::vector<Vec3>& skin, const Touches& four) {
        Soa corner[3];
        for (int j = 0; j < 3; ++j) {
            Vec4 at[smplxpp::kLanes];
            for (int lane = 0; lane < smplxpp::kLanes; ++lane)
                std::memcpy(&at[lane], &skin[size_t(four.corner[j][lane])], sizeof at[lane]);
            corner[j] = smplxpp::columns(at[0], at[1], at[2], at[3]) * four.weight[j];
        }
        return corner[0] + corner[1] + corner[2];
    }

    // Out of the collider along its smooth normal; Coulomb's friction against its own motion. What lies deep comes out no faster
    // than `kOut` and the collider: at once it would fly.
    void touch() {
        const Vec4 friction = smplxpp::all_lanes(float(f_.friction)), zero = smplxpp::all_lanes(0), one = smplxpp::all_lanes(1);
        const auto positive = [&](Vec4 a) { return smplxpp::select(a > zero, a, zero); };
        const auto less = [](Vec4 a, Vec4 b) { return smplxpp::select(b < a, b, a); };
        for (const Touches& four : touches_) {
            const Soa x = places(x_, four), point = place_on(skin_, four), &normal = four.normal;
            const Vec4 height = dot(x - point, normal);
            const Mask4 touches = taken(four) & ~(four.margin - height <= zero) & ~(height < -four.deepest);
            if (!smplxpp::any(touches)) continue;
            const Soa before = places(before_, four), skin_moved = point - place_on(skin_before_, four);
            const Vec4 depth = less(four.margin - height, smplxpp::all_lanes(kOut) + positive(dot(skin_moved, normal)) +
                positive(dot(before - x, normal)));
            Soa out = x + normal * depth, slip = (out - before) - skin_moved;
            slip = slip - normal * dot(slip, normal);
            const Vec4 way = smplxpp::length(slip);
            const Mask4 slips = way > smplxpp::all_lanes(1e-9f);
            const Vec4 stays = less(one, friction * depth / smplxpp::select(slips, way, one));
            out = out - slip * smplxpp::select(slips, stays, zero);
            put(out, touches, four);
        }
    }

    // The same without friction, between sweeps of the bound.
    void push(Constraints& constraints) {
        const Vec4 zero = smplxpp::all_lanes(0), most = smplxpp::all_lanes(kOut);
        for (const Touches& four : touches_) {
            const Soa x = places(x_, four);
            const Vec4 height = dot(x - place_on(skin_, four), four.normal), depth = four.margin - height;
            const Mask4 touches = taken(four) & ~(depth <= zero) & ~(height <= -four.deepest);
            if (!smplxpp::any(touches)) continue;
            put(x + four.normal * smplxpp::select(depth < most, depth, most), touches, four);
            for (int lane = 0; lane < smplxpp::kLanes; ++lane)
                if (touches[lane]) constraints.moved(size_t(four.particle[lane]));
        }
    }
    void put(Soa out, Mask4 which, const Touches& four) {
        Vec4 own[smplxpp::kLanes];
        smplxpp::rows(out, own);
        for (int lane = 0; lane < smplxpp::kLanes; ++lane)
            if (which[lane]) x_[size_t(four.particle[lane])] = own[lane];
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
    // What particles touch: first `sides_` fours of nearest places, then those on the other side of a fold.
    std::vector<Touches> touches_, folds_;
    size_t sides_ = 0;
    Pairs pairs_;
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
