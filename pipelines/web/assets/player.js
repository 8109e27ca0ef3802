/* smplxpp player, Apache-2.0; web/ of the project has its sources e54810fddfa3cd71a723dd2da0f962998be5eb0728487bcd9cbbd04a1c08ec0e */
"use strict";(()=>{var $=`:root {
  --ground: #121418;
  --raised: rgba(28, 31, 37, 0.86);
  --line: rgba(255, 255, 255, 0.08);
  --text: #e7e9ee;
  --faint: #8b919e;
  --accent: #8fb4ff;
  --radius: 14px;
  color-scheme: dark;
  font: 13px/1.45 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif;
}
* { box-sizing: border-box; }
html, body { margin: 0; height: 100%; overflow: hidden; background: var(--ground); color: var(--text); }
button, input, select { font: inherit; color: inherit; }
button { border: 0; background: none; padding: 0; cursor: pointer; border-radius: 8px; }
:focus-visible { outline: 2px solid var(--accent); outline-offset: 2px; }
[hidden] { display: none !important; }

.stage { position: fixed; inset: 0; width: 100%; height: 100%; touch-action: none; cursor: grab; display: block; }
.stage:active { cursor: grabbing; }

.title { position: fixed; top: 18px; left: 22px; pointer-events: none; }
.title h1 { margin: 0; font-size: 15px; font-weight: 600; letter-spacing: 0.01em; }
.title p { margin: 1px 0 0; color: var(--faint); font-size: 12px; }
.rates {
  position: fixed; top: 20px; right: 76px; color: var(--faint); font-size: 12px; text-align: right;
  font-variant-numeric: tabular-nums; pointer-events: none; white-space: nowrap;
}
.rates b { color: var(--text); font-weight: 500; }

.round {
  width: 36px; height: 36px; border-radius: 50%; display: grid; place-items: center; flex: none;
  transition: background 0.15s;
}
.round:hover { background: rgba(255, 255, 255, 0.08); }
.round svg { width: 18px; height: 18px; fill: none; stroke: currentColor; stroke-width: 1.8; stroke-linecap: round; stroke-linejoin: round; }
.round .solid { fill: currentColor; stroke: none; }
.menu { position: fixed; top: 14px; right: 22px; background: var(--raised); border: 1px solid var(--line); z-index: 3; }

.bar {
  position: fixed; left: 50%; bottom: 22px; transform: translateX(-50%); width: min(560px, calc(100vw - 44px));
  display: flex; align-items: center; gap: 10px; padding: 7px 14px 7px 8px; border-radius: 999px;
  background: var(--raised); border: 1px solid var(--line); backdrop-filter: blur(14px);
}
.bar .time { color: var(--faint); font-variant-numeric: tabular-nums; white-space: nowrap; min-width: 78px; text-align: right; }
.bar input { flex: 1; min-width: 40px; }
.bar .speed { width: 42px; height: 26px; color: var(--faint); font-variant-numeric: tabular-nums; }
.bar .speed:hover { color: var(--text); }

.panel {
  position: fixed; top: 62px; right: 22px; width: 292px; max-height: calc(100vh - 150px); z-index: 2;
  display: flex; flex-direction: column; border-radius: var(--radius); overflow: hidden;
  background: var(--raised); border: 1px solid var(--line); backdrop-filter: blur(14px);
}
.tabs { display: flex; gap: 2px; padding: 8px 8px 0; }
.tabs button { flex: 1; height: 32px; color: var(--faint); }
.tabs button[aria-selected="true"] { color: var(--text); background: rgba(255, 255, 255, 0.07); }
.page { padding: 12px 16px 16px; overflow-y: auto; scrollbar-width: thin; scrollbar-color: rgba(255, 255, 255, 0.16) transparent; }
.page .hint { color: var(--faint); margin: 0 0 10px; }
.row { display: grid; grid-template-columns: minmax(0, 1fr) 46px; gap: 2px 10px; padding: 5px 0; align-items: center; }
.row span { overflow: hidden; text-overflow: ellipsis; white-space: nowrap; }
.row output { color: var(--faint); text-align: right; font-variant-numeric: tabular-nums; }
.row input[type="range"] { grid-column: 1 / -1; }
.switch { display: flex; align-items: center; justify-content: space-between; padding: 8px 0; cursor: pointer; }
.switch input { appearance: none; width: 34px; height: 20px; border-radius: 10px; background: rgba(255, 255, 255, 0.14); position: relative; margin: 0; cursor: pointer; transition: background 0.15s; }
.switch input::after { content: ""; position: absolute; top: 3px; left: 3px; width: 14px; height: 14px; border-radius: 50%; background: #fff; transition: translate 0.15s; }
.switch input:checked { background: var(--accent); }
.switch input:checked::after { translate: 14px 0; }
.page select, .button {
  width: 100%; height: 34px; padding: 0 12px; border-radius: 8px; border: 1px solid var(--line); background: rgba(255, 255, 255, 0.05);
}
.page select option { background: #1c1f25; }
.button:hover { background: rgba(255, 255, 255, 0.1); }
.page .button { margin-top: 12px; }
.page select { margin-bottom: 8px; }
dl { display: grid; grid-template-columns: auto 1fr; gap: 5px 16px; margin: 0; }
dt { color: var(--faint); }
dd { margin: 0; text-align: right; overflow-wrap: anywhere; font-variant-numeric: tabular-nums; }

input[type="range"] { appearance: none; height: 18px; margin: 0; background: none; cursor: pointer; width: 100%; --share: 0%; }
input[type="range"]::-webkit-slider-runnable-track {
  height: 3px; border-radius: 2px;
  background: linear-gradient(to right, var(--accent) var(--share), rgba(255, 255, 255, 0.16) var(--share));
}
input[type="range"]::-webkit-slider-thumb { appearance: none; width: 13px; height: 13px; margin-top: -5px; border-radius: 50%; background: #fff; }
input[type="range"]::-moz-range-track { height: 3px; border-radius: 2px; background: rgba(255, 255, 255, 0.16); }
input[type="range"]::-moz-range-progress { height: 3px; border-radius: 2px; background: var(--accent); }
input[type="range"]::-moz-range-thumb { width: 13px; height: 13px; border: 0; border-radius: 50%; background: #fff; }

.welcome { position: fixed; inset: 0; display: grid; place-items: center; pointer-events: none; padding: 24px; }
.card {
  max-width: 420px; padding: 28px 30px; text-align: center; border-radius: var(--radius); pointer-events: auto;
  background: rgba(28, 31, 37, 0.97); border: 1px solid var(--line);
}
.card h2 { margin: 0 0 6px; font-size: 16px; font-weight: 600; }
.card p { margin: 0 0 18px; color: var(--faint); overflow-wrap: anywhere; }
.card.failed h2 { color: #ffb4a8; }
.card .button { width: auto; padding: 0 18px; margin: 0 4px; }
.spinner { width: 26px; height: 26px; margin: 0 auto 14px; border-radius: 50%; border: 2px solid var(--line); border-top-color: var(--accent); animation: turn 0.9s linear infinite; }
@keyframes turn { to { rotate: 1turn; } }
.dropping::after { content: "Drop to open"; position: fixed; inset: 14px; display: grid; place-items: center; font-size: 16px; border: 2px dashed var(--accent); border-radius: var(--radius); background: rgba(18, 20, 24, 0.7); z-index: 9; }

@media (max-width: 640px) {
  .rates { top: auto; bottom: 76px; right: 0; left: 0; text-align: center; font-size: 11px; }
  .title { top: 16px; left: 18px; }
  .menu { right: 16px; }
  .bar { bottom: 16px; width: calc(100vw - 24px); }
  .panel { top: auto; left: 0; right: 0; bottom: 0; width: auto; max-height: 58vh; border-radius: 18px 18px 0 0; padding-bottom: env(safe-area-inset-bottom); }
  .panel:not([hidden]) ~ .rates, .panel:not([hidden]) ~ .bar { display: none; }
}
@media (prefers-reduced-motion: reduce) { * { transition: none !important; } }
`;function T(n,e=0){let t=n[e],r=n[e+1],o=n[e+2],s=Math.hypot(t,r,o),a=s>1e-8?Math.sin(s/2)/s:.5;return[Math.cos(s/2),a*t,a*r,a*o]}function G(n){let e=n[0]<0?-1:1,t=Math.hypot(n[1],n[2],n[3]),r=t>1e-12?2*Math.atan2(t,e*n[0])*e/t:2*e;return[r*n[1],r*n[2],r*n[3]]}function q(n,e){return[n[0]*e[0]-n[1]*e[1]-n[2]*e[2]-n[3]*e[3],n[0]*e[1]+n[1]*e[0]+n[2]*e[3]-n[3]*e[2],n[0]*e[2]-n[1]*e[3]+n[2]*e[0]+n[3]*e[1],n[0]*e[3]+n[1]*e[2]-n[2]*e[1]+n[3]*e[0]]}function W(n,e,t){let r=n[0]*e[0]+n[1]*e[1]+n[2]*e[2]+n[3]*e[3],o=r<0?-1:1;r=Math.min(1,Math.abs(r));let s=Math.acos(r),a=Math.sin(s),i=a>1e-6?Math.sin((1-t)*s)/a:1-t,l=o*(a>1e-6?Math.sin(t*s)/a:t),c=[0,0,0,0];for(let p=0;p<4;++p)c[p]=i*n[p]+l*e[p];let d=Math.hypot(...c);return c.map(p=>p/d)}var v=14;function j(n,e){return{rotations:new Float64Array(3*n),translation:new Float64Array(3),expression:new Float64Array(e)}}function V(n){return(n.frames-1)/n.framesPerSecond}function C(n,e){let t=Math.min(Math.max(e*n.framesPerSecond,0),n.frames-1),r=Math.min(Math.floor(t),Math.max(n.frames-2,0)),o=t-r,s=Math.min(r+1,n.frames-1),a=c=>{let d=c.length/n.frames,p=new Float64Array(d);for(let h=0;h<d;++h)p[h]=(1-o)*c[r*d+h]+o*c[s*d+h];return p},i=n.rotations.length/n.frames,l=new Float64Array(i);for(let c=0;c<i;c+=3){let[d,p]=[r,s].map(h=>h*i+c);if(o===0)l.set(n.rotations.subarray(d,d+3),c);else{let[h,f]=[d,p].map(m=>T(n.rotations,m));l.set(G(W(h,f,o)),c)}}return{rotations:l,translation:a(n.translation),expression:a(n.expression)}}function Y(n,e){let t=n.rotations.slice();for(let[r,o]of e){let s=q(T(t,3*r),T(o));t.set(G(s),3*r)}return{...n,rotations:t}}var Ee=.6;function X(n,e,t){let{azimuth:r,elevation:o,distance:s,target:a}=n,i=[Math.sin(r)*Math.cos(o),Math.sin(o),Math.cos(r)*Math.cos(o)],l=[Math.cos(r),0,-Math.sin(r)],c=i.map(m=>-m),d=[c[1]*l[2]-c[2]*l[1],c[2]*l[0]-c[0]*l[2],c[0]*l[1]-c[1]*l[0]],p=a.map((m,g)=>m+s*i[g]),h=[l,d,c].flatMap(m=>[...m,-m.reduce((g,b,x)=>g+b*p[x],0)]),f=.5*t/Math.tan(.5*Ee);return{view:h,fx:f,fy:f,cx:e/2,cy:t/2,width:e,height:t}}function K(n,e,t,r){let o=n.distance/r.fy,s=r.view,a=n.target.map((i,l)=>i-o*(e*s[l]+t*s[4+l]));return{...n,target:a}}var Ae=[.071,.078,.094],Pe=64,Te=.78,ke=.72,Re=20,k=class{constructor(e,t){this.renderer=e;this.canvas=t;let r=URL.createObjectURL(new Blob(['"use strict";(()=>{var ie=11920929e-12;function ge(e,t,r,o){for(let s=0;s<o.length;++s){let n=3*t[3*s],a=3*t[3*s+1],l=3*t[3*s+2],i=e[a]-e[n],c=e[a+1]-e[n+1],f=e[a+2]-e[n+2],m=e[l]-e[n],u=e[l+1]-e[n+1],y=e[l+2]-e[n+2],g=T(i,c,f)+T(m,u,y)+T(m-i,u-c,y-f),d=Math.max(g/3,1e-6),h=c*y-f*u,b=f*m-i*y,p=i*u-c*m,w=.5*(i+m),v=.5*(c+u),A=.5*(f+y);T(h,b,p)<=ie*d*d&&(T(w,v,A)<=ie*(g/3)&&([w,v,A]=[i,c,f]),T(w,v,A)<=ie*1e-6&&([w,v,A]=[1,0,0]),[h,b,p]=et(w,v,A));let M=1/T(h,b,p),_=1/T(w,v,A);h*=M,b*=M,p*=M,w*=_,v*=_,A*=_;let k=9*s;r[k]=h,r[k+1]=w,r[k+2]=b*A-p*v,r[k+3]=b,r[k+4]=v,r[k+5]=p*w-h*A,r[k+6]=p,r[k+7]=A,r[k+8]=h*v-b*w,o[s]=d}}function T(e,t,r){return Math.sqrt(e*e+t*t+r*r)}function et(e,t,r){let[o,s,n]=[Math.abs(e),Math.abs(t),Math.abs(r)];return o<=s&&o<=n?[0,r,-t]:s<=n?[-r,0,e]:[t,-e,0]}var le=.4886025119029199,L=[1.0925484305920792,.31539156525252005,.5462742152960396],R=[.5900435899266435,2.890611442640554,.4570457994644658,.3731763325901154,1.445305721320277];function be(e,t,r,o,s){if(s[0]=-le*t,s[1]=le*r,s[2]=-le*e,o<8)return;let n=e*e,a=t*t,l=r*r;s[3]=L[0]*e*t,s[4]=-L[0]*t*r,s[5]=L[1]*(2*l-n-a),s[6]=-L[0]*e*r,s[7]=L[2]*(n-a),!(o<15)&&(s[8]=-R[0]*t*(3*n-a),s[9]=R[1]*e*t*r,s[10]=-R[2]*t*(4*l-n-a),s[11]=R[3]*r*(2*l-3*n-3*a),s[12]=-R[2]*e*(4*l-n-a),s[13]=R[4]*r*(n-a),s[14]=-R[0]*e*(n-3*a))}function ce(e,t,r,o,s,n){let{inputs:a,outputs:l,weight:i,bias:c}=e;for(let f=0;f<l;++f){let m=c[f],u=0,y=0,g=0,d=f*a,h=r;for(let p=r+a-3;h<p;h+=4,d+=4)m+=i[d]*t[h],u+=i[d+1]*t[h+1],y+=i[d+2]*t[h+2],g+=i[d+3]*t[h+3];for(;h<r+a;++h,++d)m+=i[d]*t[h];let b=m+u+y+g;o[s+f]=n&&b<0?0:b}}function fe(e,t){let r=t;return e.forEach((o,s)=>{let n=new Float32Array(o.outputs);ce(o,r,0,n,0,s+1<e.length),r=n}),r}var Q=4;function tt(e,t,r){let{inputs:o,outputs:s,weight:n,bias:a}=e;for(let l=0;l<s;l+=2){let i=a[l],c=i,f=i,m=i,u=a[l+1],y=u,g=u,d=u,h=l*o;for(let p=0;p<4*o;p+=4,++h){let w=n[h],v=n[h+o],A=t[p],M=t[p+1],_=t[p+2],k=t[p+3];i+=w*A,c+=w*M,f+=w*_,m+=w*k,u+=v*A,y+=v*M,g+=v*_,d+=v*k}let b=4*l;r[b]=i>0?i:0,r[b+1]=c>0?c:0,r[b+2]=f>0?f:0,r[b+3]=m>0?m:0,r[b+4]=u>0?u:0,r[b+5]=y>0?y:0,r[b+6]=g>0?g:0,r[b+7]=d>0?d:0}}function nt({inputs:e,outputs:t,weight:r,bias:o}){let s=t+t%2,n={inputs:e,outputs:s,weight:new Float64Array(s*e),bias:new Float64Array(s)};return n.weight.set(r),n.bias.set(o),n}var G=class{constructor(t){this.field=t;let r=t.setOf.length;this.points=new Float32Array(3*r);let o=(n,a)=>({network:n,hidden:n.hidden.map(nt),where:a});this.networks=[o(t.body,Int32Array.from({length:r},(n,a)=>a)),o(t.cloth,t.clothPoints)];let s=Q*(t.body.last.inputs+1);this.scratch=[new Float64Array(s),new Float64Array(s)]}points;networks;scratch;displacements(t,r){let{field:o,points:s}=this;s.fill(0);for(let a of this.networks)this.add(a,t);let n=o.neighbourCount;for(let a=0;a<r.length/3;++a){let l=0,i=0,c=0;for(let f=a*n;f<(a+1)*n;++f){let m=o.weights[f],u=3*o.neighbours[f];l+=m*s[u],i+=m*s[u+1],c+=m*s[u+2]}r[3*a]=l,r[3*a+1]=i,r[3*a+2]=c}}add({network:t,hidden:r,where:o},s){let{field:n,points:a}=this,{ofPoint:l,last:i}=t,c=t.ofFrame.outputs,f=this.ofSets(t,s);for(let m=0;m<o.length;m+=Q){let[u,y]=this.scratch,g=Math.min(Q,o.length-m);for(let d=0;d<Q;++d){let h=o[m+Math.min(d,g-1)],b=n.setOf[h]*c;for(let p=0;p<c;++p)u[4*p+d]=Math.max(0,l[h*c+p]+f[b+p])}for(let d of r)tt(d,u,y),[u,y]=[y,u];for(let d=0;d<g;++d)for(let h=0;h<3;++h){let b=i.bias[h];for(let p=0;p<c;++p)b+=i.weight[h*c+p]*u[4*p+d];a[3*o[m+d]+h]+=b}}}ofSets(t,r){let{sets:o,code:s}=this.field,n=r.length/3,a=o.length/n,l=t.ofFrame.outputs,i=new Float32Array(r.length+s.length),c=new Float32Array(a*l);i.set(s,r.length);for(let f=0;f<a;++f){for(let m=0;m<r.length;++m)i[m]=r[m]*o[f*n+Math.floor(m/3)];ce(t.ofFrame,i,0,c,f*l,!1)}return c}};function we(e,t,r){let o=t.length/r,s=(o-3)/6,n=e.length/3,a=new Float32Array(o),l=new Float32Array(n*r),i={inputs:o,outputs:r,weight:t,bias:new Float32Array(r)};for(let c=0;c<n;++c){for(let f=0;f<3;++f){a[f]=e[3*c+f];for(let m=0;m<s;++m){let u=e[3*c+f]*Math.PI*2**m;a[3+3*m+f]=Math.sin(u),a[3+3*s+3*m+f]=Math.cos(u)}}ce(i,a,0,l,c*r,!1)}return l}var Ae=22,K=class{values;shapes;known;constructor(t){this.shapes=t.blendShapes,this.known=t.known,this.values=new Float32Array(6*(this.shapes?t.gaussians.count:0))}pose(t,r){if(!this.shapes)return;this.values.fill(0);let{head:o,body:s,jaw:n}=this.shapes,a=new Float32Array(o.layers[0].inputs),l=a.length-(n?3:0);a.set(t.expression.subarray(0,l)),n&&a.set(t.rotations.subarray(3*Ae,3*Ae+3),l),this.add(o,fe(o.layers,a),1);let i=this.known?rt(this.known,r):1;i>1e-4&&this.add(s,fe(s.layers,r),i)}add(t,r,o){let{rows:s,values:n,step:a,exponent:l,shapes:i}=t,c=this.values,f=this.shapes.part,m=c.length/6,u=i?n.length/(6*i):0,y=new Float32Array(u);for(let g=0;g<6;++g){y.fill(0);let d=h=>o*(a?a[6*h+g]:1);if(f)for(let h=0;h<i;++h){let b=(6*h+g)*u,p=d(h);for(let w=0;w<u;++w)y[w]+=n[b+w]*p*r[f[s?s[w]:w]*i+h]}else{let h=p=>p<i?d(p)*r[p]:0,b=p=>(6*Math.min(p,i-1)+g)*u;for(let p=0;p<i;p+=4){let[w,v,A,M]=[h(p),h(p+1),h(p+2),h(p+3)],[_,k,U,I]=[b(p),b(p+1),b(p+2),b(p+3)];for(let N=0;N<u;++N)y[N]+=w*n[_+N]+v*n[k+N]+A*n[U+N]+M*n[I+N]}}for(let h=0;h<u;++h)c[g*m+(s?s[h]:h)]+=l?y[h]*2**l[h]:y[h]}}};function rt(e,t){let r=1/0;for(let s=0;s<e.poses.length;s+=t.length){let n=0;for(let a=0;a<t.length;++a)n+=(e.poses[s+a]-t[a])**2;r=Math.min(r,n)}let o=Math.max(0,(Math.sqrt(r)-e.scale)/e.scale);return Math.exp(-.5*o*o)}function Fe(e,t,r,o){let s=e[t],n=e[t+1],a=e[t+2],l=s*s+n*n+a*a,i=Math.sqrt(l),c=i>1e-4?Math.sin(i)/i:1-l/6,f=i>1e-4?(1-Math.cos(i))/l:.5-l/24;r[o]=1-f*(n*n+a*a),r[o+1]=f*s*n-c*a,r[o+2]=f*s*a+c*n,r[o+3]=f*s*n+c*a,r[o+4]=1-f*(s*s+a*a),r[o+5]=f*n*a-c*s,r[o+6]=f*s*a-c*n,r[o+7]=f*n*a+c*s,r[o+8]=1-f*(s*s+n*n)}function ve(e,t=0){let r=e[t],o=e[t+1],s=e[t+2],n=Math.hypot(r,o,s),a=n>1e-8?Math.sin(n/2)/n:.5;return[Math.cos(n/2),a*r,a*o,a*s]}function xe(e){let t=e[0]<0?-1:1,r=Math.hypot(e[1],e[2],e[3]),o=r>1e-12?2*Math.atan2(r,t*e[0])*t/r:2*t;return[o*e[1],o*e[2],o*e[3]]}function Me(e,t,r){let o=e[0]*t[0]+e[1]*t[1]+e[2]*t[2]+e[3]*t[3],s=o<0?-1:1;o=Math.min(1,Math.abs(o));let n=Math.acos(o),a=Math.sin(n),l=a>1e-6?Math.sin((1-r)*n)/a:1-r,i=s*(a>1e-6?Math.sin(r*n)/a:r),c=[0,0,0,0];for(let m=0;m<4;++m)c[m]=l*e[m]+i*t[m];let f=Math.hypot(...c);return c.map(m=>m/f)}var H=class{constructor(t){this.skeleton=t;let r=t.parents.length;this.local=new Float64Array(9*r),this.posedFromRest=new Float64Array(12*r),this.turned=new Float64Array(9*r),this.place=new Float64Array(3*r),this.rest=new Float64Array(3*r)}local;posedFromRest;turned;place;rest;pose(t){let{parents:r,byExpression:o,rest:s}=this.skeleton,{local:n,turned:a,place:l,rest:i,posedFromRest:c}=this,f=t.expression.length;for(let m=0;m<i.length;++m){let u=s[m];for(let y=0;y<f;++y)u+=o[m*f+y]*t.expression[y];i[m]=u}for(let m=0;m<r.length;++m){Fe(t.rotations,3*m,n,9*m);let u=r[m];if(u<0){for(let y=0;y<9;++y)a[9*m+y]=n[9*m+y];for(let y=0;y<3;++y)l[3*m+y]=i[3*m+y]+t.translation[y]}else{let y=9*u;for(let g=0;g<3;++g){let d=l[3*u+g];for(let h=0;h<3;++h)d+=a[y+3*g+h]*(i[3*m+h]-i[3*u+h]);l[3*m+g]=d;for(let h=0;h<3;++h){let b=0;for(let p=0;p<3;++p)b+=a[y+3*g+p]*n[9*m+3*p+h];a[9*m+3*g+h]=b}}}for(let y=0;y<3;++y){let g=l[3*m+y];for(let d=0;d<3;++d)c[12*m+4*y+d]=a[9*m+3*y+d],g-=a[9*m+3*y+d]*i[3*m+d];c[12*m+4*y+3]=g}}}};var he=14,st=21,q=class{constructor(t){this.avatar=t;let{mesh:r,skeleton:o}=t;this.vertices=new Float32Array(r.vertices.length),this.rest=new Float32Array(r.vertices.length),this.moved=new Float32Array(r.vertices.length),this.rotations=new Float32Array(3*r.faces.length),this.lengths=new Float32Array(r.faces.length/3),this.centers=new Float32Array(3*t.gaussians.count),this.joints=new H(o),this.field=t.field&&new G(t.field),this.residuals=new K(t)}vertices;centers;joints;field;residuals;rest;moved;rotations;lengths;pose(t){let{mesh:r}=this.avatar,o=Float32Array.from(t.rotations.subarray(3,3+3*st));this.joints.pose(t),this.field?.displacements(o,this.moved),this.shape(t),ot(this.rest,r.joints,r.weights,this.joints.posedFromRest,this.vertices),ge(this.vertices,r.faces,this.rotations,this.lengths),this.residuals.pose(t,o),this.place()}place(){let{gaussians:t,mesh:{faces:r}}=this.avatar,{rotations:o,vertices:s,centers:n}=this,a=this.residuals.values,l=t.count,i=a.length>0;for(let c=0;c<l;++c){let f=t.face[c],m=9*f,u=3*r[3*f],y=3*r[3*f+1],g=3*r[3*f+2],d=t.barycentric[2*c],h=t.barycentric[2*c+1],b=1-d-h,p=t.offset[3*c],w=t.offset[3*c+1],v=t.offset[3*c+2];i&&(p+=a[c],w+=a[l+c],v+=a[2*l+c]);for(let A=0;A<3;++A){let M=o[m+3*A]*p+o[m+3*A+1]*w+o[m+3*A+2]*v;n[3*c+A]=d*s[u+A]+h*s[y+A]+b*s[g+A]+M}}}shape(t){let{vertices:r,expressions:o,correctives:s}=this.avatar.mesh;for(let n=0;n<r.length;++n)this.rest[n]=r[n]+this.moved[n];if(ke(this.rest,o.rows,o.basis,Float32Array.from(t.expression)),s){let n=new Float32Array(s.size);for(let a=0;a<n.length;++a)n[a]=this.joints.local[9+a]-(a%9%4===0?1:0);ke(this.rest,s.rows,s.basis,n)}}records(t,r,o){let s=this.avatar.gaussians,{rotations:n,lengths:a,centers:l}=this,i=this.residuals.values,c=s.count,f=s.harmonicCount,m=i.length>0,u=new Float64Array(Math.max(f,3)),y=r?r.length:c;for(let g=0,d=0;g<y;++g,d+=he){let h=r?r[g]:g,b=s.face[h],p=9*b,w=l[3*h],v=l[3*h+1],A=l[3*h+2];o[d]=w,o[d+1]=v,o[d+2]=A,o[d+3]=s.opacity[h];let M=6*h,_=a[b]*a[b],k=_*s.covariance[M],U=_*s.covariance[M+1],I=_*s.covariance[M+2],N=_*s.covariance[M+3],O=_*s.covariance[M+4],Z=_*s.covariance[M+5],ee=n[p]*k+n[p+1]*U+n[p+2]*I,te=n[p]*U+n[p+1]*N+n[p+2]*O,ne=n[p]*I+n[p+1]*O+n[p+2]*Z,pe=n[p+3]*k+n[p+4]*U+n[p+5]*I,ye=n[p+3]*U+n[p+4]*N+n[p+5]*O,de=n[p+3]*I+n[p+4]*O+n[p+5]*Z,He=n[p+6]*k+n[p+7]*U+n[p+8]*I,qe=n[p+6]*U+n[p+7]*N+n[p+8]*O,Je=n[p+6]*I+n[p+7]*O+n[p+8]*Z;o[d+4]=ee*n[p]+te*n[p+1]+ne*n[p+2],o[d+5]=ee*n[p+3]+te*n[p+4]+ne*n[p+5],o[d+6]=ee*n[p+6]+te*n[p+7]+ne*n[p+8],o[d+7]=pe*n[p+3]+ye*n[p+4]+de*n[p+5],o[d+8]=pe*n[p+6]+ye*n[p+7]+de*n[p+8],o[d+9]=He*n[p+6]+qe*n[p+7]+Je*n[p+8];let re=s.color[3*h],se=s.color[3*h+1],oe=s.color[3*h+2];if(m&&(re+=i[3*c+h],se+=i[4*c+h],oe+=i[5*c+h]),f){let P=w-t[0],z=v-t[1],j=A-t[2],ae=1/Math.sqrt(P*P+z*z+j*j);P*=ae,z*=ae,j*=ae;let Xe=n[p]*P+n[p+3]*z+n[p+6]*j,Ye=n[p+1]*P+n[p+4]*z+n[p+7]*j,Ze=n[p+2]*P+n[p+5]*z+n[p+8]*j;be(Xe,Ye,Ze,f,u);for(let D=0,V=3*f*h;D<f;++D,V+=3)re+=u[D]*s.harmonics[V],se+=u[D]*s.harmonics[V+1],oe+=u[D]*s.harmonics[V+2]}o[d+10]=Math.max(0,re),o[d+11]=Math.max(0,se),o[d+12]=Math.max(0,oe)}}};function ke(e,t,r,o){let s=o.length,n=[...o.keys()].filter(a=>o[a]!==0);for(let a=0;a<t.length;++a)for(let l=0;l<3;++l){let i=0;for(let c of n)i+=r[(3*a+l)*s+c]*o[c];e[3*t[a]+l]+=i}}function ot(e,t,r,o,s){let n=e.length/3,a=r.length/n,l=new Float64Array(12);for(let i=0;i<n;++i){l.fill(0);for(let u=i*a;u<(i+1)*a;++u){let y=r[u];if(y===0)continue;let g=12*t[u];for(let d=0;d<12;++d)l[d]+=y*o[g+d]}let c=e[3*i],f=e[3*i+1],m=e[3*i+2];s[3*i]=l[0]*c+l[1]*f+l[2]*m+l[3],s[3*i+1]=l[4]*c+l[5]*f+l[6]*m+l[7],s[3*i+2]=l[8]*c+l[9]*f+l[10]*m+l[11]}}function _e(e,t){return{rotations:new Float64Array(3*e),translation:new Float64Array(3),expression:new Float64Array(t)}}function $e(e,t){let r=Math.min(Math.max(t*e.framesPerSecond,0),e.frames-1),o=Math.min(Math.floor(r),Math.max(e.frames-2,0)),s=r-o,n=Math.min(o+1,e.frames-1),a=c=>{let f=c.length/e.frames,m=new Float64Array(f);for(let u=0;u<f;++u)m[u]=(1-s)*c[o*f+u]+s*c[n*f+u];return m},l=e.rotations.length/e.frames,i=new Float64Array(l);for(let c=0;c<l;c+=3){let[f,m]=[o,n].map(u=>u*l+c);if(s===0)i.set(e.rotations.subarray(f,f+3),c);else{let[u,y]=[f,m].map(g=>ve(e.rotations,g));i.set(xe(Me(u,y,s)),c)}}return{rotations:i,translation:a(e.translation),expression:a(e.expression)}}var J=class{range=[0,1];counts=new Uint32Array(65537);keys;shown;order;depths;constructor(t){this.keys=new Uint16Array(t),this.shown=new Uint32Array(t),this.order=new Uint32Array(t),this.depths=new Float32Array(t)}sort(t,r,o,s,n,a=!0){let{depths:l,shown:i,keys:c,counts:f,order:m}=this,u=0,y=1/0,g=-1/0;for(let h=0;h<l.length;++h){let b=r[0]*t[3*h]+r[1]*t[3*h+1]+r[2]*t[3*h+2]+r[3];!(b>=o)||n.has(s[h])||(l[u]=b,i[u++]=h,b<y&&(y=b),b>g&&(g=b))}if(this.range=u?[y,g]:[0,1],!a)return i.subarray(0,u);let d=g>y?65535/(g-y):0;f.fill(0);for(let h=0;h<u;++h)c[h]=(l[h]-y)*d,++f[c[h]+1];for(let h=0;h<65536;++h)f[h+1]+=f[h];for(let h=0;h<u;++h)m[f[c[h]]++]=i[h];return m.subarray(0,u)}};var F=class extends Error{constructor(r,o,s,n=""){super(`${r}: expected ${o}, received ${s}${n?`; ${n}`:""}`);this.subject=r;this.expected=o;this.received=s;this.remedy=n;this.name="BundleError"}},x="export the avatar anew with smplxpp export";var Ne={"of_point.weight":"f W X","of_frame.weight":"f W Y","of_frame.bias":"f W","hidden.weight":"f H W W","hidden.bias":"f H W","last.weight":"f 3 W","last.bias":"f 3"},Ee=e=>ue(e,{rows:`i? ${e}m <N`,values:`q ${e}n 6 ${e}m`,step:`f? ${e}n 6`,exponent:`i? ${e}m`,"first.weight":`f ${e}w ${e}i`,"first.bias":`f ${e}w`,"hidden.weight":`f ${e}h ${e}w ${e}w`,"hidden.bias":`f ${e}h ${e}w`,"last.weight":`f ${e}o ${e}w`,"last.bias":`f ${e}o`}),Ue={skeleton:{parents:"i J",joints:"f J 3",expression:"f J 3 E",left_hand_mean:"f? 45",right_hand_mean:"f? 45",left_hand_components:"f? l 45",right_hand_components:"f? r 45"},surface:{vertices:"f V 3",faces:"i F 3 <V",parts:"i V",labels:"i V",colors:"i V 3",joint_indices:"i V k <J",joint_weights:"f V k",expression_rows:"i R <V",expression:"f R 3 E",pose_rows:"i? Q <V",pose:"f? Q 3 P"},gaussians:{per_face:"i F",barycentric:"f N 2",offset:"f N 3",log_scales:"f N 2",quats:"f N 4",opacities:"f N",dc:"f N 3",sh:"f N K 3"},field:{points:"f C 3",neighbours:"i V n <C",weights:"f V n",cloth:"i c <C",sets:"i S 21",member:"i C <S",codes:"f T Z",...ue("body",Ne),...ue("cloth",Ne)},blend:{...Ee("head"),...Ee("body"),part:"i? N"},poses:{known:"f D 63",scale:"f"}},at=["skeleton","surface","gaussians"];function ue(e,t){return Object.fromEntries(Object.entries(t).map(([r,o])=>[`${e}.${r}`,o]))}var X=class{sizes={};all=new Map;constructor(t){for(let[r,o]of Object.entries(Ue)){let s=t.get(r);if(!s){if(at.includes(r))throw new F("the avatar",`a piece ${r}`,"none",x);continue}for(let[n,a]of Object.entries(o))this.take(`${r}.${n}`,n,a,s)}this.checkBounds()}has(t){return this.all.has(t)}floats(t){return this.all.get(t).values}ints(t){return this.all.get(t).values}steps(t){return this.all.get(t).values}take(t,r,o,s){let[n,...a]=o.split(" "),l=s.get(r);if(!l){if(!n.endsWith("?"))throw new F(t,"a tensor","none",x);return}let i=a.filter(y=>!y.startsWith("<")),c=i.length===l.shape.length&&i.every((y,g)=>(/^\\d/.test(y)?Number(y):this.sizes[y]??=l.shape[g])===l.shape[g]),f=l.dtype.startsWith("F"),m=n.startsWith("i")?!f:f||n==="q"||s.has(`${r}.step`);if(!c||!m)throw new F(t,`${n[0]==="i"?"integers":"numbers"} of shape (${i.join(", ")})`,`${l.dtype} of shape (${l.shape.join(", ")})`,x);let u=l.values;n.startsWith("i")?u=u instanceof Int32Array?u:Int32Array.from(u):n==="q"&&u instanceof Int8Array||(u=it(t,l,s,r)),this.all.set(t,{...l,values:u})}checkBounds(){for(let[t,r]of Object.entries(Ue))for(let[o,s]of Object.entries(r)){let n=s.split("<")[1],a=`${t}.${o}`;if(!n||!this.has(a))continue;let l=this.sizes[n];if(this.ints(a).some(i=>i<0||i>=l))throw new F(a,`indices below ${l}`,"others",x)}}};function it(e,t,r,o){let s=Float32Array.from(t.values);for(let n of["step","start"]){let a=r.get(`${o}.${n}`)?.values;if(a){if(!a.length||s.length%a.length)throw new F(`${e}.${n}`,"numbers for the last axes",`${a.length}`,x);for(let l=0,i=0;l<s.length;++l,i=i+1===a.length?0:i+1)s[l]=n==="step"?s[l]*a[i]:s[l]+a[i]}}if(!s.every(Number.isFinite))throw new F(e,"finite numbers","NaN or infinity",x);return s}var S=45,lt={55:["global_orient","body_pose","jaw_pose","leye_pose","reye_pose","left_hand_pose","right_hand_pose"],52:["global_orient","body_pose","left_hand_pose","right_hand_pose"],24:["global_orient","body_pose"]},Ie=30;function Te(e,t,r){let o=t.skeleton.parents.length,s=t.expressionNames.length,n=g=>{let d=e.get(g);if(d?.shape.length!==2||!d.values.every(Number.isFinite))throw new F(`motion: ${g}`,"a row of numbers a frame","none",x);return d},a=n("global_orient").shape[0],l=!!e.get("flat_hand_mean")?.values[0],i=new Float32Array(a*o*3),c=0;for(let g of lt[o]??[]){let d=n(g),h=g.replace("_pose",""),b=h.endsWith("hand"),p=b?S:d.shape[1],w=b&&!l&&r.has(`skeleton.${h}_mean`)?r.floats(`skeleton.${h}_mean`):null,v=b&&d.shape[1]<S?ct(d,r,h):d.values;if(v.length!==a*p||c+p>3*o)throw new F(`motion: ${g}`,`${a} frames`,`shape (${d.shape.join(", ")})`,x);for(let A=0;A<a;++A)for(let M=0;M<p;++M)i[A*3*o+c+M]=v[A*p+M]+(w?w[M]:0);c+=p}let f=n("expression"),m=f.shape[1],u=new Float32Array(a*s);for(let g=0;g<Math.min(a,f.shape[0]);++g)for(let d=0;d<Math.min(s,m);++d)u[g*s+d]=f.values[g*m+d];let y=Float32Array.from(n("transl").values);if(!a||y.length!==3*a)throw new F("motion: transl",`${a} frames`,`${y.length/3}`,x);return{framesPerSecond:Number(e.get("fps")?.values[0]??Ie)||Ie,frames:a,rotations:i,translation:y,expression:u}}function ct(e,t,r){let[o,s]=e.shape,n=`skeleton.${r}_components`;if(!t.has(n)||t.floats(n).length<s*S)throw new F(`motion: ${r}_pose`,`${S} numbers a frame`,`${s}`,x);let a=t.floats(n),l=new Float32Array(o*S);for(let i=0;i<o;++i)for(let c=0;c<s;++c)for(let f=0;f<S;++f)l[i*S+f]+=e.values[i*s+c]*a[c*S+f];return l}var Be=new Uint32Array(64),Oe=new Uint32Array(8);{let e=t=>Array.from({length:t},(r,o)=>o).every(r=>r<2||t%r!==0);for(let t=2,r=0;r<64;++t)e(t)&&(Be[r]=Se(t,3),r<8&&(Oe[r]=Se(t,2)),++r)}function Se(e,t){let r=BigInt(e)<<BigInt(32*t),o=0n,s=1n<<40n;for(;s-o>1n;){let n=o+s>>1n;n**BigInt(t)<=r?o=n:s=n}return Number(o&0xffffffffn)}async function Pe(e){return globalThis.crypto?.subtle?ze(new Uint8Array(await crypto.subtle.digest("SHA-256",e))):ft(e)}function ft(e){let t=Math.ceil((e.length+9)/64),r=Math.floor(e.length/64),o=new Uint8Array(64*(t-r));o.set(e.subarray(64*r)),o[e.length-64*r]=128;let s=new DataView(o.buffer);s.setUint32(o.length-8,Math.floor(e.length/2**29)),s.setUint32(o.length-4,e.length<<3>>>0);let n=Uint32Array.from(Oe),a=new Uint32Array(64),l=new DataView(e.buffer,e.byteOffset,e.byteLength);for(let c=0;c<t;++c)c<r?Re(n,a,l,64*c):Re(n,a,s,64*(c-r));let i=new DataView(new ArrayBuffer(32));return n.forEach((c,f)=>i.setUint32(4*f,c)),ze(new Uint8Array(i.buffer))}function Re(e,t,r,o){for(let u=0;u<16;++u)t[u]=r.getUint32(o+4*u);for(let u=16;u<64;++u){let y=t[u-15],g=t[u-2],d=E(y,7)^E(y,18)^y>>>3,h=E(g,17)^E(g,19)^g>>>10;t[u]=t[u-16]+d+t[u-7]+h|0}let[s,n,a,l,i,c,f,m]=e;for(let u=0;u<64;++u){let y=E(i,6)^E(i,11)^E(i,25),g=m+y+(i&c^~i&f)+Be[u]+t[u]|0,h=(E(s,2)^E(s,13)^E(s,22))+(s&n^s&a^n&a)|0;m=f,f=c,c=i,i=l+g|0,l=a,a=n,n=s,s=g+h|0}[s,n,a,l,i,c,f,m].forEach((u,y)=>e[y]+=u)}function E(e,t){return e>>>t|e<<32-t}function ze(e){return[...e].map(t=>t.toString(16).padStart(2,"0")).join("")}var C;function ht(){if(C)return C;C=new Float32Array(65536);for(let e=0;e<65536;++e){let t=e&32768?-1:1,r=e>>10&31,o=e&1023;C[e]=r===31?o?NaN:t*(1/0):t*(r?2**(r-15)*(1+o/1024):2**-14*o/1024)}return C}function je(e){let t=ht(),r=new Float32Array(e.length);for(let o=0;o<e.length;++o)r[o]=t[e[o]];return r}var ut={F64:{bytes:8,make:e=>new Float64Array(e)},F32:{bytes:4,make:e=>new Float32Array(e)},F16:{bytes:2,make:e=>je(new Uint16Array(e))},I64:{bytes:8,make:e=>Int32Array.from(new BigInt64Array(e),Number)},I32:{bytes:4,make:e=>new Int32Array(e)},I16:{bytes:2,make:e=>new Int16Array(e)},I8:{bytes:1,make:e=>new Int8Array(e)},U32:{bytes:4,make:e=>new Uint32Array(e)},U16:{bytes:2,make:e=>new Uint16Array(e)},U8:{bytes:1,make:e=>new Uint8Array(e)},BOOL:{bytes:1,make:e=>new Uint8Array(e)}};function De(e,t){let r=a=>new F(t,"tensors behind a header",a,x),o=e.length<8?1/0:Number(new DataView(e.buffer,e.byteOffset).getBigUint64(0,!0));if(o>e.length-8)throw r(`${e.length} bytes of something else`);let s;try{s=JSON.parse(new TextDecoder().decode(e.subarray(8,8+o)))}catch{throw r("a damaged header")}let n=new Map;for(let[a,{dtype:l="",shape:i=[],data_offsets:c=[]}]of Object.entries(s)){if(a==="__metadata__")continue;let f=ut[l],[m,u]=c,y=i.reduce((d,h)=>d*h,1)*(f?.bytes??NaN);if(!(m>=0&&u-m===y&&u<=e.length-8-o))throw r(`a damaged ${a}`);let g=e.byteOffset+8+o+m;n.set(a,{dtype:l,shape:i,values:f.make(e.buffer.slice(g,g+y))})}return n}var mt=101010256,pt=33639248,Le=67324752,yt=22,dt=65535,gt=64,bt=512*2**20,wt=4*2**20,At=100,Ft=/^[a-z][a-z0-9_]{0,60}\\.[a-z]{1,16}$/;async function Ce(e){let t=new DataView(e.buffer,e.byteOffset,e.byteLength),r=vt(t),o=r.reduce((n,a)=>n+a.unpacked,0);if(o>Math.min(bt,Math.max(wt,At*e.length)))throw $(`${e.length} bytes that unpack to ${o}`);let s=new Map;for(let n of r){if(!Ft.test(n.name)||s.has(n.name))throw $(`a piece "${n.name.slice(0,80)}"`);s.set(n.name,await xt(e,t,n))}return s}function $(e){return new F("the file","an avatar that smplxpp export wrote",e,x)}function vt(e){let t=e.byteLength-yt,r=Math.max(0,t-dt);for(;t>=r&&e.getUint32(t,!0)!==mt;)--t;if(t<r){let a=e.byteLength>=4&&e.getUint32(0,!0)===Le;throw $(a?`the beginning of one: the file is cut off after ${e.byteLength} bytes`:"another file")}let o=e.getUint16(t+10,!0),s=e.getUint32(t+16,!0);if(o>gt)throw $(`${o} pieces`);let n=[];for(let a=0;a<o;++a){if(s+46>t||e.getUint32(s,!0)!==pt)throw $("a damaged directory");let[l,i,c]=[28,30,32].map(f=>e.getUint16(s+f,!0));if(s+46+l>t)throw $("a damaged directory");n.push({name:new TextDecoder().decode(new Uint8Array(e.buffer,e.byteOffset+s+46,l)),method:e.getUint16(s+10,!0),packed:e.getUint32(s+20,!0),unpacked:e.getUint32(s+24,!0),offset:e.getUint32(s+42,!0)}),s+=46+l+i+c}return n}async function xt(e,t,r){let{name:o,offset:s,packed:n,method:a}=r;if(s+30>e.length||t.getUint32(s,!0)!==Le)throw $(`no piece ${o} in its place`);let l=s+30+t.getUint16(s+26,!0)+t.getUint16(s+28,!0);if(l+n>e.length)throw $(`a piece ${o} that is cut off`);let i=e.slice(l,l+n);if(a===0&&n===r.unpacked)return i;if(a!==8)throw $(`a piece ${o} packed in another way`);let c=new Uint8Array(r.unpacked),f=0;try{let m=new Blob([i]).stream().pipeThrough(new DecompressionStream("deflate-raw")).getReader();for(let u=await m.read();!u.done;u=await m.read()){if(f+u.value.length>c.length)throw await m.cancel(),$(`a piece ${o} longer than it says`);c.set(u.value,f),f+=u.value.length}}catch(m){throw m instanceof F?m:$(`a damaged piece ${o}`)}if(f!==c.length)throw $(`a piece ${o} shorter than it says`);return c}var Mt="smplxpp-avatar",We=1,kt=.01;async function Ve(e){let t=await Ce(e),r=_t(t.get("manifest.json"));if(r.version>We)throw new F("the avatar",`version ${We} or older`,`version ${r.version}`,"open it with the player of the smplxpp that wrote it");let o=new Map;for(let[s,{file:n="",bytes:a,sha256:l}]of Object.entries(r.pieces??{})){let i=t.get(n);if(!i)throw new F("the avatar",`a piece ${n}`,"none",x);if(i.length!==a||await Pe(i)!==l)throw new F(`piece ${s}`,"the bytes that the manifest\'s digest is of","others: the file is damaged or was changed",x);s!=="garments"&&o.set(s,De(i,`piece ${s}`))}return $t(r,new X(o),o.get("motion"),e.length)}function _t(e){let t;try{t=e&&JSON.parse(new TextDecoder().decode(e))}catch{}if(t?.format!==Mt||!Number.isInteger(t.version))throw new F("the file","an avatar that smplxpp export wrote","another archive",x);return t}function $t(e,t,r,o){let{J:s,E:n,V:a}=t.sizes,l=e.model??{},i=t.ints("skeleton.parents");if(!(i[0]===-1&&i.every((d,h)=>h===0||d>=0&&d<h)))throw new F("skeleton.parents","every parent before its children","another order",x);let f=(d,h,b)=>d?.length===h?d.map(String):Array.from({length:h},(p,w)=>`${b} ${w+1}`),m=t.ints("surface.parts"),u=m.reduce((d,h)=>Math.max(d,h),0)+1,y=t.ints("surface.faces"),g={name:String(l.name??"avatar"),licence:String(l.licence??""),provenance:l.provenance??{},partNames:f(l.part_names?.slice(0,u),u,"part"),expressionNames:f(l.expression_names,n,"expression"),blur:Number(l.eps2d??.1),skeleton:{names:f(l.joint_names,s,"joint"),parents:i,rest:t.floats("skeleton.joints"),byExpression:t.floats("skeleton.expression")},mesh:{vertices:t.floats("surface.vertices"),faces:y,joints:t.ints("surface.joint_indices"),weights:Ge(t.floats("surface.joint_weights"),t.sizes.k),influences:t.sizes.k,parts:m,expressions:{rows:t.ints("surface.expression_rows"),basis:t.floats("surface.expression"),size:n},correctives:t.has("surface.pose")&&t.has("surface.pose_rows")&&t.sizes.P===9*(s-1)?{rows:t.ints("surface.pose_rows"),basis:t.floats("surface.pose"),size:t.sizes.P}:null},field:t.has("field.points")?Nt(t,!!l.null_code_shown,a):null,blendShapes:t.has("blend.head.values")?Et(t,!!l.jaw):null,known:t.has("poses.known")?{poses:t.floats("poses.known"),scale:t.floats("poses.scale")[0]}:null,gaussians:Ut(t,y,m),motion:null,bytes:o};return r&&(g.motion=Te(r,g,t)),g}function W(e,t,r=0,o=1){let s=e.floats(`${t}.weight`),n=e.floats(`${t}.bias`),a=n.length/o,l=s.length/o/a;return{inputs:l,outputs:a,weight:s.subarray(r*l*a,(r+1)*l*a),bias:n.subarray(r*a,(r+1)*a)}}function Qe(e,t,r){return Array.from({length:r},(o,s)=>W(e,t,s,r))}function Nt(e,t,r){let{Z:o,H:s,W:n,n:a}=e.sizes,l=e.floats("field.points"),i=f=>({ofPoint:we(l,e.floats(`field.${f}.of_point.weight`),n),ofFrame:W(e,`field.${f}.of_frame`),hidden:Qe(e,`field.${f}.hidden`,s),last:W(e,`field.${f}.last`)}),c=i("body");if(c.ofFrame.inputs!==63+o||r*a!==e.ints("field.neighbours").length)throw new F("field",`${63+o} inputs`,`${c.ofFrame.inputs}`,x);return{body:c,cloth:i("cloth"),clothPoints:e.ints("field.cloth"),code:t?new Float32Array(o):e.floats("field.codes").slice(0,o),sets:Float32Array.from(e.ints("field.sets")),setOf:e.ints("field.member"),neighbours:e.ints("field.neighbours"),weights:Ge(e.floats("field.weights"),a),neighbourCount:a}}function Et(e,t){let r=l=>{let i=m=>`blend.${l}.${m}`,c=e.sizes[`${l}n`],f=e.has(i("rows"))?e.ints(i("rows")):null;if(!f&&e.sizes[`${l}m`]!==e.sizes.N)throw new F(i("values"),`${e.sizes.N} rows`,`${e.sizes[`${l}m`]}`,x);return{layers:[W(e,i("first")),...Qe(e,i("hidden"),e.sizes[`${l}h`]),W(e,i("last"))],shapes:c,rows:f,values:e.steps(i("values")),step:e.has(i("step"))?e.floats(i("step")):null,exponent:e.has(i("exponent"))?e.ints(i("exponent")):null}},o=e.has("blend.part")?e.ints("blend.part"):null,[s,n]=[r("head"),r("body")],a=o?o.reduce((l,i)=>Math.max(l,i),0)+1:1;for(let{layers:l,shapes:i}of[s,n])if(l.at(-1).outputs<a*i)throw new F("blend",`${a} x ${i} coefficients`,`${l.at(-1).outputs}`,x);return{head:s,body:n,jaw:t,part:o}}function Ut(e,t,r){let{N:o,K:s,F:n}=e.sizes,a=e.ints("gaussians.per_face"),l=new Int32Array(o),i=new Uint8Array(o),c=0;for(let f=0;f<n;++f)l.fill(f,c,c+a[f]),i.fill(r[t[3*f]],c,c+a[f]),c+=a[f];if(c!==o||a.some(f=>f<0))throw new F("gaussians.per_face",`counts of ${o}`,`${c}`,x);return{count:o,face:l,part:i,barycentric:e.floats("gaussians.barycentric"),offset:e.floats("gaussians.offset"),covariance:It(e.floats("gaussians.quats"),e.floats("gaussians.log_scales")),opacity:e.floats("gaussians.opacities"),color:e.floats("gaussians.dc"),harmonics:e.floats("gaussians.sh"),harmonicCount:s}}function Ge(e,t){let r=new Float32Array(e.length);for(let o=0;o<e.length;o+=t){let s=0;for(let n=0;n<t;++n)s+=e[o+n];for(let n=0;n<t;++n)r[o+n]=e[o+n]/Math.max(s,1e-12)}return r}function It(e,t){let r=e.length/4,o=new Float32Array(6*r);for(let s=0;s<r;++s){let n=Math.hypot(...e.subarray(4*s,4*s+4)),[a,l,i,c]=e.subarray(4*s,4*s+4).map(y=>y/n),f=[[1-2*(i*i+c*c),2*(l*i-a*c),2*(l*c+a*i)],[2*(l*i+a*c),1-2*(l*l+c*c),2*(i*c-a*l)],[2*(l*c-a*i),2*(i*c+a*l),1-2*(l*l+i*i)]],m=[kt**2,Math.exp(2*t[2*s]),Math.exp(2*t[2*s+1])],u=6*s;for(let y=0;y<3;++y)for(let g=y;g<3;++g)o[u++]=m.reduce((d,h,b)=>d+h*f[y][b]*f[g][b],0)}return o}function Ke({view:e}){return[0,1,2].map(t=>-(e[t]*e[3]+e[4+t]*e[7]+e[8+t]*e[11]))}var me=self,B=null,Y=null;me.onmessage=async e=>{try{let[t,r]=e.data.kind==="open"?await St(e.data.data):Bt(e.data);me.postMessage(t,r)}catch(t){let r=t instanceof F?t.message:`the player failed: ${String(t)}`;me.postMessage({kind:"failed",message:r},[])}};async function St(e){let t=await Ve(new Uint8Array(e));return B=new q(t),Y=new J(t.gaussians.count),[{kind:"opened",summary:Rt(t,B)},[]]}function Rt(e,t){t.pose(e.motion?$e(e.motion,0):_e(e.skeleton.names.length,e.expressionNames.length));let r=[1/0,1/0,1/0],o=[-1/0,-1/0,-1/0];return t.centers.forEach((s,n)=>{r[n%3]=Math.min(r[n%3],s),o[n%3]=Math.max(o[n%3],s)}),{name:e.name,licence:e.licence,provenance:e.provenance,partNames:e.partNames,expressionNames:e.expressionNames,jointNames:e.skeleton.names,count:e.gaussians.count,bytes:e.bytes,blur:e.blur,motion:e.motion,middle:r.map((s,n)=>(s+o[n])/2),reach:(o[1]-r[1])/2}}function Bt(e){if(!B||!Y)throw new Error("no avatar is open");let{camera:t}=e,{gaussians:r}=B.avatar,o=performance.now();B.pose(e.pose);let s=performance.now(),n=t.view.slice(8,12),a=Y.sort(B.centers,n,.01,r.part,new Set(e.hidden),e.sorted),l=performance.now(),i=4*he*r.count,c=e.records?.byteLength===i?e.records:new ArrayBuffer(i);B.records(Ke(t),a,new Float32Array(c));let f=performance.now(),m=s-o+(f-l),u=l-s;return[{kind:"frame",records:c,count:a.length,camera:t,depths:Y.range,deform:m,sort:u},[c]]}})();\n'],{type:"text/javascript"}));this.worker=new Worker(r),this.worker.onmessage=o=>this.answer(o.data),this.worker.onerror=o=>this.answer({kind:"failed",message:`the player failed: ${o.message}`})}summary=null;playing=!0;time=0;speed=1;orbit={target:[0,0,0],distance:3,azimuth:0,elevation:0};hidden=new Set;turns=new Map;expressions=new Map;pictures=0;rates={fps:0,deform:0,sort:0,draw:null};onpicture=()=>{};onerror=()=>{};worker;spare=[];answer=()=>{};queue=Promise.resolve();asked=0;ready=null;changed=!0;still=!1;before=0;lastDrawn=0;tick=0;async open(e){let t=await this.ask({kind:"open",data:e},[e]);if(t.kind!=="opened")throw new Error(t.kind==="failed"?t.message:"no avatar");return this.summary=t.summary,this.time=0,this.hidden.clear(),this.turns.clear(),this.expressions.clear(),this.spare.length=0,this.resetView(),this.tick||(this.tick=requestAnimationFrame(this.step)),t.summary}resetView(){if(!this.summary)return;let{middle:e,reach:t}=this.summary,{width:r,height:o,fx:s}=this.camera(),a=2*t*s/(Te*o),i=2*ke*t*s/r;this.orbit={target:[...e],distance:Math.max(a,i),azimuth:.35,elevation:.06},this.update()}update(){this.changed=!0}async picture(e){this.still=!0;try{await this.queue,this.ready=null;let t=await this.ask(this.request(e),[]);if(t.kind!=="frame")throw new Error(t.kind==="failed"?t.message:"no picture");return this.show(t,e.background),await this.renderer.pixels()}finally{this.still=!1,this.update()}}pose(e){let{motion:t,jointNames:r,expressionNames:o}=this.summary,s=t?C(t,e):j(r.length,o.length);for(let[a,i]of this.expressions)s.expression[a]=i;return this.turns.size?Y(s,this.turns):s}get duration(){return this.summary?.motion?V(this.summary.motion):0}step=e=>{this.tick=requestAnimationFrame(this.step);let t=Math.min(.25,(e-this.before)/1e3);if(this.before=e,this.playing&&this.duration>0&&(this.time=(this.time+t*this.speed)%this.duration,this.changed=!0),this.still||this.renderer.lost){this.changed=!0;return}if(this.renderer.busy)return;let r=this.ready;this.ready=null,!this.asked&&this.changed&&(this.changed=!1,this.ask(this.request({time:this.time,camera:this.camera()}),[]).then(o=>{o.kind==="frame"?this.ready=o:o.kind==="failed"&&this.onerror(o.message)})),r&&this.show(r)};camera(){let e=Math.min(window.devicePixelRatio||1,2),[t,r]=[this.canvas.clientWidth,this.canvas.clientHeight].map(i=>Math.max(1,Math.round(i*e))),{motion:o}=this.summary,s=[...this.orbit.target];if(o){let i=C(o,this.time).translation;for(let l of[0,2])s[l]+=i[l]-o.translation[l]}let a=X({...this.orbit,target:s},t,r);return{...a,cy:a.cy-.5*Pe*e}}request({time:e,camera:t}){return{kind:"frame",pose:this.pose(e),camera:t,hidden:[...this.hidden],sorted:!this.renderer.sorts,records:this.spare.pop()??null}}ask(e,t){e.kind==="frame"&&e.records&&t.push(e.records),++this.asked;let r=this.queue.then(()=>new Promise(o=>{this.answer=o,this.worker.postMessage(e,t)}));return this.queue=r,r.finally(()=>--this.asked)}show(e,t=Ae){let r=new Float32Array(e.records),{camera:o,count:s,depths:a}=e;this.renderer.draw({records:r,count:s,camera:o,background:t,depths:a,blur:this.summary.blur}),r.length===v*this.summary.count&&this.spare.length<2&&this.spare.push(e.records);let i=performance.now(),l=this.rates,c=(d,p)=>d?d+(p-d)/Re:p;this.lastDrawn&&i-this.lastDrawn<2e3&&(l.fps=1e3/c(l.fps&&1e3/l.fps,i-this.lastDrawn)),this.lastDrawn=i,l.deform=c(l.deform,e.deform),l.sort=c(l.sort,e.sort),l.draw=this.renderer.milliseconds,++this.pictures,this.onpicture()}};var Q=`#version 300 es
precision highp float;
layout(location = 0) in vec4 place;
layout(location = 1) in vec4 covariance0;
layout(location = 2) in vec2 covariance1;
layout(location = 3) in vec4 color;
uniform mat3 rotation;
uniform vec3 translation;
uniform vec4 pinhole;
uniform vec2 size;
uniform float blur;
out vec2 at;
flat out vec4 paint;
flat out float reach;

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  vec3 p = rotation * place.xyz + translation;
  reach = log(255.0 * place.w);
  if (!(p.z >= 0.01) || !(reach > 0.0)) return;
  vec2 focal = pinhole.xy, middle = pinhole.zw;
  vec2 center = focal * p.xy / p.z + middle;

  // The derivative is taken inside the picture, widened by 15 % on every side.
  vec2 low = (-0.15 * size - middle) / focal, high = (1.15 * size - middle) / focal;
  vec2 slope = clamp(p.xy / p.z, low, high);
  vec3 jx = vec3(focal.x / p.z, 0.0, -focal.x * slope.x / p.z) * rotation;
  vec3 jy = vec3(0.0, focal.y / p.z, -focal.y * slope.y / p.z) * rotation;
  mat3 v = mat3(covariance0.x, covariance0.y, covariance0.z, covariance0.y, covariance0.w, covariance1.x,
    covariance0.z, covariance1.x, covariance1.y);
  vec3 vx = v * jx, vy = v * jy;
  float a = dot(jx, vx) + blur, b = dot(jx, vy), c = dot(jy, vy) + blur;

  float mean = 0.5 * (a + c), spread = sqrt(0.25 * (a - c) * (a - c) + b * b);
  float angle = 0.5 * atan(2.0 * b, a - c);
  vec2 along = vec2(cos(angle), sin(angle));
  vec2 corner = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1)) * 2.0 - 1.0;
  // Half axes where sigma = reach: sqrt(2 reach lambda).
  float longer = sqrt(2.0 * reach * (mean + spread)), shorter = sqrt(2.0 * reach * max(mean - spread, 1e-9));
  vec2 pixel = center + corner.x * longer * along + corner.y * shorter * vec2(-along.y, along.x);
  at = corner;
  paint = vec4(color.rgb, place.w);
  gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0.0, 1.0);
}`,J=`#version 300 es
precision highp float;
in vec2 at;
flat in vec4 paint;
flat in float reach;
out vec4 result;

void main() {
  float square = dot(at, at);
  if (square > 1.0) discard;
  float alpha = min(0.999, paint.a * exp(-reach * square));
  result = vec4(paint.rgb * alpha, alpha);
}`,Z=`#version 300 es
void main() {
  gl_Position = vec4(4.0 * float(gl_VertexID & 1) - 1.0, 4.0 * float(gl_VertexID >> 1) - 1.0, 0.0, 1.0);
}`,ee=`#version 300 es
precision highp float;
uniform sampler2D blended;
uniform vec3 background;
out vec4 result;

void main() {
  vec4 value = texelFetch(blended, ivec2(gl_FragCoord.xy), 0);
  result = vec4(value.rgb + value.a * background, 1.0);
}`;var Fe=[4,4,2,4],R=class{constructor(e){this.canvas=e;let t=e.getContext("webgl2",{alpha:!1,antialias:!1,depth:!1,powerPreference:"high-performance"});if(!t)throw new Error("this browser has no WebGL2");this.gl=t,this.resources=this.make(),e.addEventListener("webglcontextlost",r=>{r.preventDefault(),this.lost=!0,this.query=null,this.fence=null}),e.addEventListener("webglcontextrestored",()=>{this.resources=this.make(),this.lost=!1})}name="WebGL2";sorts=!1;lost=!1;milliseconds=null;gl;resources;timer=null;fence=null;query=null;get busy(){let{gl:e,fence:t}=this;return t!==null&&!this.lost&&e.clientWaitSync(t,0,0)===e.TIMEOUT_EXPIRED}draw({records:e,count:t,camera:r,background:o,blur:s}){if(this.lost)return;let{gl:a,resources:i}=this,{width:l,height:c,view:d}=r;this.fit(l,c),a.bindVertexArray(i.array),a.bindBuffer(a.ARRAY_BUFFER,i.buffer),i.capacity<t&&(i.capacity=e.length/v,a.bufferData(a.ARRAY_BUFFER,4*e.length,a.STREAM_DRAW)),a.bufferSubData(a.ARRAY_BUFFER,0,e,0,t*v);let p=this.startTimer();a.bindFramebuffer(a.FRAMEBUFFER,i.target),a.viewport(0,0,l,c),a.clearColor(0,0,0,1),a.clear(a.COLOR_BUFFER_BIT),a.useProgram(i.splats);let h=m=>a.getUniformLocation(i.splats,m),f=[0,1,2].flatMap(m=>[d[m],d[4+m],d[8+m]]);a.uniformMatrix3fv(h("rotation"),!1,f),a.uniform3f(h("translation"),d[3],d[7],d[11]),a.uniform4f(h("pinhole"),r.fx,r.fy,r.cx,r.cy),a.uniform2f(h("size"),l,c),a.uniform1f(h("blur"),s),a.enable(a.BLEND),a.blendFuncSeparate(a.DST_ALPHA,a.ONE,a.ZERO,a.ONE_MINUS_SRC_ALPHA),a.drawArraysInstanced(a.TRIANGLE_STRIP,0,4,t),a.bindFramebuffer(a.FRAMEBUFFER,null),a.disable(a.BLEND),a.useProgram(i.resolve),a.bindTexture(a.TEXTURE_2D,i.texture),a.uniform3f(a.getUniformLocation(i.resolve,"background"),...o),a.drawArrays(a.TRIANGLES,0,3),a.bindVertexArray(null),p&&a.endQuery(this.timer.TIME_ELAPSED_EXT),a.deleteSync(this.fence),this.fence=a.fenceSync(a.SYNC_GPU_COMMANDS_COMPLETE,0),a.flush()}async pixels(){let{gl:e,canvas:{width:t,height:r}}=this,o=new Uint8Array(4*t*r),s=new Uint8Array(o.length);e.readPixels(0,0,t,r,e.RGBA,e.UNSIGNED_BYTE,o);let a=4*t;for(let i=0;i<r;++i)s.set(o.subarray(i*a,(i+1)*a),(r-1-i)*a);return s}lose(){let e=this.gl.getExtension("WEBGL_lose_context");this.lost=e!==null,e?.loseContext(),setTimeout(()=>e?.restoreContext(),100)}startTimer(){let{gl:e,timer:t,query:r}=this;if(!t)return!1;if(r){if(!e.getQueryParameter(r,e.QUERY_RESULT_AVAILABLE))return!1;!e.getParameter(t.GPU_DISJOINT_EXT)&&(this.milliseconds=Number(e.getQueryParameter(r,e.QUERY_RESULT))/1e6),e.deleteQuery(r)}return this.query=e.createQuery(),this.query&&e.beginQuery(t.TIME_ELAPSED_EXT,this.query),this.query!==null}make(){let{gl:e}=this;this.timer=e.getExtension("EXT_disjoint_timer_query_webgl2"),this.query=null;let t=e.createVertexArray(),r=e.createBuffer();e.bindVertexArray(t),e.bindBuffer(e.ARRAY_BUFFER,r);let o=0;return Fe.forEach((s,a)=>{e.enableVertexAttribArray(a),e.vertexAttribPointer(a,s,e.FLOAT,!1,4*v,o),e.vertexAttribDivisor(a,1),o+=4*s}),e.bindVertexArray(null),{splats:this.program(Q,J),resolve:this.program(Z,ee),array:t,buffer:r,capacity:0,target:e.createFramebuffer(),texture:e.createTexture(),width:0,height:0}}fit(e,t){let{gl:r,canvas:o,resources:s}=this;if((o.width!==e||o.height!==t)&&([o.width,o.height]=[e,t]),s.width===e&&s.height===t)return;[s.width,s.height]=[e,t];let a=r.getExtension("EXT_color_buffer_float")||r.getExtension("EXT_color_buffer_half_float");r.bindTexture(r.TEXTURE_2D,s.texture),r.texImage2D(r.TEXTURE_2D,0,a?r.RGBA16F:r.RGBA8,e,t,0,r.RGBA,a?r.HALF_FLOAT:r.UNSIGNED_BYTE,null),r.texParameteri(r.TEXTURE_2D,r.TEXTURE_MIN_FILTER,r.NEAREST),r.texParameteri(r.TEXTURE_2D,r.TEXTURE_MAG_FILTER,r.NEAREST),r.bindFramebuffer(r.FRAMEBUFFER,s.target),r.framebufferTexture2D(r.FRAMEBUFFER,r.COLOR_ATTACHMENT0,r.TEXTURE_2D,s.texture,0)}program(e,t){let{gl:r}=this,o=r.createProgram();for(let[s,a]of[[r.VERTEX_SHADER,e],[r.FRAGMENT_SHADER,t]]){let i=r.createShader(s);r.shaderSource(i,a),r.compileShader(i),r.attachShader(o,i)}if(r.linkProgram(o),!r.getProgramParameter(o,r.LINK_STATUS)&&!r.isContextLost())throw new Error(`shaders of the player: ${r.getProgramInfoLog(o)}`);return o}};var E=`
struct Scene {
  row0: vec4f,
  row1: vec4f,
  row2: vec4f,
  pinhole: vec4f,
  size: vec2f,
  blur: f32,
  count: u32,
  depths: vec2f,
  tiles: u32,
  unused: u32,
}
struct Splat {
  center: vec2f,
  longer: vec2f,
  shorter: vec2f,
  color: vec2u,
}
`,te=`${E}
@group(0) @binding(0) var<uniform> scene: Scene;
@group(0) @binding(1) var<storage, read> records: array<f32>;
@group(0) @binding(2) var<storage, read_write> splats: array<Splat>;
@group(0) @binding(3) var<storage, read_write> keys: array<u32>;
@group(0) @binding(4) var<storage, read_write> order: array<u32>;

@compute @workgroup_size(64)
fn project(@builtin(global_invocation_id) id: vec3u) {
  let i = id.x;
  if (i >= scene.count) { return; }
  let at = 14u * i;
  let mean = vec4f(records[at], records[at + 1u], records[at + 2u], 1.0);
  let opacity = records[at + 3u];
  let p = vec3f(dot(scene.row0, mean), dot(scene.row1, mean), dot(scene.row2, mean));
  let reach = log(255.0 * opacity);
  order[i] = i;
  let span = max(scene.depths.y - scene.depths.x, 1e-6);
  keys[i] = u32(clamp((p.z - scene.depths.x) / span, 0.0, 1.0) * 65535.0);
  splats[i] = Splat(vec2f(0.0), vec2f(0.0), vec2f(0.0), vec2u(0u));
  if (!(p.z >= 0.01) || !(reach > 0.0)) { return; }

  let focal = scene.pinhole.xy;
  let middle = scene.pinhole.zw;
  // The derivative is taken inside the picture, widened by 15 % on every side.
  let low = (-0.15 * scene.size - middle) / focal;
  let high = (1.15 * scene.size - middle) / focal;
  let slope = clamp(p.xy / p.z, low, high);
  let jx = (focal.x / p.z) * (scene.row0.xyz - slope.x * scene.row2.xyz);
  let jy = (focal.y / p.z) * (scene.row1.xyz - slope.y * scene.row2.xyz);
  let xx = records[at + 4u];
  let xy = records[at + 5u];
  let xz = records[at + 6u];
  let yy = records[at + 7u];
  let yz = records[at + 8u];
  let zz = records[at + 9u];
  let v = mat3x3f(xx, xy, xz, xy, yy, yz, xz, yz, zz);
  let vx = v * jx;
  let vy = v * jy;
  let a = dot(jx, vx) + scene.blur;
  let b = dot(jx, vy);
  let c = dot(jy, vy) + scene.blur;
  let mean2 = 0.5 * (a + c);
  let spread = sqrt(0.25 * (a - c) * (a - c) + b * b);
  let angle = 0.5 * atan2(2.0 * b, a - c);
  let along = vec2f(cos(angle), sin(angle));
  // Half axes where sigma = reach: sqrt(2 reach lambda).
  let longer = sqrt(2.0 * reach * (mean2 + spread)) * along;
  let shorter = sqrt(2.0 * reach * max(mean2 - spread, 1e-9)) * vec2f(-along.y, along.x);
  let color = vec4f(records[at + 10u], records[at + 11u], records[at + 12u], opacity);
  let packed = vec2u(pack2x16float(color.rg), pack2x16float(color.ba));
  splats[i] = Splat(focal * p.xy / p.z + middle, longer, shorter, packed);
}
`,re=`${E}
struct Pass { shift: u32 }
@group(0) @binding(0) var<uniform> scene: Scene;
@group(0) @binding(1) var<uniform> step: Pass;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read_write> counts: array<u32>;
var<workgroup> found: array<atomic<u32>, 16>;

@compute @workgroup_size(128)
fn count(@builtin(workgroup_id) tile: vec3u, @builtin(local_invocation_index) thread: u32) {
  if (thread < 16u) { atomicStore(&found[thread], 0u); }
  workgroupBarrier();
  let first = tile.x * 1024u + thread * 8u;
  for (var k = first; k < min(first + 8u, scene.count); k++) {
    atomicAdd(&found[(keys[k] >> step.shift) & 15u], 1u);
  }
  workgroupBarrier();
  if (thread < 16u) { counts[thread * scene.tiles + tile.x] = atomicLoad(&found[thread]); }
}
`,ne=`${E}
@group(0) @binding(0) var<uniform> scene: Scene;
@group(0) @binding(1) var<storage, read_write> counts: array<u32>;
const WIDE = 256u;
var<workgroup> sums: array<u32, WIDE>;

@compute @workgroup_size(WIDE)
fn scan(@builtin(local_invocation_index) thread: u32) {
  let whole = 16u * scene.tiles;
  let share = (whole + WIDE - 1u) / WIDE;
  let first = thread * share;
  let last = min(first + share, whole);
  var sum = 0u;
  for (var k = first; k < last; k++) { sum += counts[k]; }
  sums[thread] = sum;
  workgroupBarrier();
  for (var step = 1u; step < WIDE; step *= 2u) {
    var before = 0u;
    if (thread >= step) { before = sums[thread - step]; }
    workgroupBarrier();
    sums[thread] += before;
    workgroupBarrier();
  }
  var start = sums[thread] - sum;
  for (var k = first; k < last; k++) {
    let count = counts[k];
    counts[k] = start;
    start += count;
  }
}
`,ae=`${E}
struct Pass { shift: u32 }
@group(0) @binding(0) var<uniform> scene: Scene;
@group(0) @binding(1) var<uniform> step: Pass;
@group(0) @binding(2) var<storage, read> starts: array<u32>;
@group(0) @binding(3) var<storage, read> keys: array<u32>;
@group(0) @binding(4) var<storage, read> order: array<u32>;
@group(0) @binding(5) var<storage, read_write> newKeys: array<u32>;
@group(0) @binding(6) var<storage, read_write> newOrder: array<u32>;
// Of every digit, what every thread has of it: then where the thread's first of it goes.
var<workgroup> places: array<u32, 2048>;

@compute @workgroup_size(128)
fn scatter(@builtin(workgroup_id) tile: vec3u, @builtin(local_invocation_index) thread: u32) {
  for (var d = 0u; d < 16u; d++) { places[d * 128u + thread] = 0u; }
  let first = tile.x * 1024u + thread * 8u;
  let last = min(first + 8u, scene.count);
  for (var k = first; k < last; k++) {
    places[((keys[k] >> step.shift) & 15u) * 128u + thread] += 1u;
  }
  workgroupBarrier();
  if (thread < 16u) {
    var start = starts[thread * scene.tiles + tile.x];
    for (var t = 0u; t < 128u; t++) {
      let at = thread * 128u + t;
      let count = places[at];
      places[at] = start;
      start += count;
    }
  }
  workgroupBarrier();
  for (var k = first; k < last; k++) {
    let key = keys[k];
    let at = ((key >> step.shift) & 15u) * 128u + thread;
    let to = places[at];
    places[at] = to + 1u;
    newKeys[to] = key;
    newOrder[to] = order[k];
  }
}
`,oe=`${E}
@group(0) @binding(0) var<uniform> scene: Scene;
@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> order: array<u32>;

struct Corner {
  @builtin(position) position: vec4f,
  @location(0) at: vec2f,
  @location(1) @interpolate(flat) paint: vec4f,
}

@vertex
fn corner(@builtin(vertex_index) vertex: u32, @builtin(instance_index) instance: u32) -> Corner {
  let splat = splats[order[instance]];
  let at = vec2f(f32(vertex & 1u), f32(vertex >> 1u)) * 2.0 - 1.0;
  let pixel = splat.center + at.x * splat.longer + at.y * splat.shorter;
  let paint = vec4f(unpack2x16float(splat.color.x), unpack2x16float(splat.color.y));
  let position = vec4f(2.0 * pixel.x / scene.size.x - 1.0, 1.0 - 2.0 * pixel.y / scene.size.y, 0.0, 1.0);
  return Corner(position, at, paint);
}

@fragment
fn blend(in: Corner) -> @location(0) vec4f {
  let square = dot(in.at, in.at);
  if (square > 1.0) { discard; }
  let alpha = min(0.999, in.paint.a * exp(-log(255.0 * in.paint.a) * square));
  return vec4f(in.paint.rgb * alpha, alpha);
}
`,D=`
@group(0) @binding(0) var blended: texture_2d<f32>;
@group(0) @binding(1) var<uniform> background: vec4f;

@vertex
fn whole(@builtin(vertex_index) vertex: u32) -> @builtin(position) vec4f {
  return vec4f(4.0 * f32(vertex & 1u) - 1.0, 4.0 * f32(vertex >> 1u) - 1.0, 0.0, 1.0);
}

@fragment
fn resolve(@builtin(position) at: vec4f) -> @location(0) vec4f {
  let value = textureLoad(blended, vec2i(at.xy), 0);
  return vec4f(value.rgb + value.a * background.rgb, 1.0);
}
`;var ue="rgba16float",de="rgba8unorm",_e=2,Le=32,Ue=64,le=256,F=class n{constructor(e,t){this.canvas=e;this.context=t}name="WebGPU";sorts=!0;lost=!1;milliseconds=null;pending=0;device;pipelines;scene;background;shifts=[];buffers=null;target=null;static async make(e){let t=await ce();if(!t||!await Ge(t))return null;let r=e.getContext("webgpu");if(!r)return null;let o=new n(e,r);return await o.start(t),o}get busy(){return this.pending>=_e}draw({records:e,count:t,camera:r,background:o,blur:s,depths:a}){if(this.lost)return;let{device:i,pipelines:l}=this,{width:c,height:d,view:p}=r;this.fit(c,d);let h=this.sized(e.length/v),f=Math.max(1,Math.ceil(t/1024)),m=new ArrayBuffer(96);new Float32Array(m).set([...p,r.fx,r.fy,r.cx,r.cy,c,d,s]),new Uint32Array(m)[19]=t,new Float32Array(m).set(a,20),new Uint32Array(m)[22]=f,i.queue.writeBuffer(this.scene,0,m),i.queue.writeBuffer(this.background,0,new Float32Array([...o,1])),i.queue.writeBuffer(h.records,0,e.buffer,e.byteOffset,4*v*t);let g=i.createCommandEncoder(),b=g.beginComputePass(),x=(w,ye,xe)=>{b.setPipeline(w),b.setBindGroup(0,ye),b.dispatchWorkgroups(xe)};x(l.project,h.project,Math.max(1,Math.ceil(t/Ue)));for(let w=0;w<4;++w)x(l.count,h.count_[w],f),x(l.scan,h.scan,1),x(l.scatter,h.scatter[w],f);b.end();let be=this.target.createView(),P=g.beginRenderPass({colorAttachments:[{view:be,loadOp:"clear",storeOp:"store",clearValue:[0,0,0,1]}]});P.setPipeline(l.draw),P.setBindGroup(0,h.draw),t&&P.draw(4,t),P.end(),this.resolve(g,l.resolve,this.context.getCurrentTexture().createView());let ve=performance.now();i.queue.submit([g.finish()]),++this.pending;let H=()=>{--this.pending,this.milliseconds=performance.now()-ve};i.queue.onSubmittedWorkDone().then(H,H)}async pixels(){let{device:e,canvas:{width:t,height:r}}=this,o=Math.ceil(4*t/le)*le,s=GPUTextureUsage.RENDER_ATTACHMENT|GPUTextureUsage.COPY_SRC,a=e.createTexture({size:[t,r],format:de,usage:s}),i=e.createBuffer({size:o*r,usage:GPUBufferUsage.COPY_DST|GPUBufferUsage.MAP_READ}),l=e.createCommandEncoder();this.resolve(l,this.pipelines.resolveToRead,a.createView()),l.copyTextureToBuffer({texture:a},{buffer:i,bytesPerRow:o},[t,r]),e.queue.submit([l.finish()]),await i.mapAsync(GPUMapMode.READ);let c=new Uint8Array(i.getMappedRange()),d=new Uint8Array(4*t*r);for(let p=0;p<r;++p)d.set(c.subarray(p*o,p*o+4*t),4*p*t);return i.destroy(),a.destroy(),d}lose(){this.lost=!0,this.device.destroy()}resolve(e,t,r){let o=e.beginRenderPass({colorAttachments:[{view:r,loadOp:"clear",storeOp:"store"}]});o.setPipeline(t),o.setBindGroup(0,this.device.createBindGroup({layout:t.getBindGroupLayout(0),entries:[{binding:0,resource:this.target.createView()},{binding:1,resource:{buffer:this.background}}]})),o.draw(3),o.end()}async start(e){this.device=e,e.lost.then(()=>this.recover());let t=navigator.gpu.getPreferredCanvasFormat();this.context.configure({device:e,format:t,alphaMode:"opaque"});let r=o=>e.createBuffer({size:o,usage:GPUBufferUsage.UNIFORM|GPUBufferUsage.COPY_DST});this.scene=r(96),this.background=r(16),this.shifts=Array.from({length:4},(o,s)=>{let a=r(16);return e.queue.writeBuffer(a,0,new Uint32Array([s*16/4])),a}),this.buffers=null,this.target=null,this.pipelines=await Ce(e,t),this.lost=!1}async recover(){this.lost=!0;let e=await ce();e&&await this.start(e)}fit(e,t){let{canvas:r}=this;if((r.width!==e||r.height!==t)&&([r.width,r.height]=[e,t]),this.target?.width===e&&this.target.height===t)return;this.target?.destroy();let o=GPUTextureUsage.RENDER_ATTACHMENT|GPUTextureUsage.TEXTURE_BINDING;this.target=this.device.createTexture({size:[e,t],format:ue,usage:o})}sized(e){if(this.buffers?.count===e)return this.buffers;let{device:t,pipelines:r,scene:o}=this,s=f=>t.createBuffer({size:Math.max(f,16),usage:GPUBufferUsage.STORAGE|GPUBufferUsage.COPY_DST}),a=s(4*v*e),i=s(Le*e),l=[s(4*e),s(4*e)],c=[s(4*e),s(4*e)],d=s(64*Math.max(1,Math.ceil(e/1024))),p=(f,...m)=>t.createBindGroup({layout:f.getBindGroupLayout(0),entries:m.map((g,b)=>({binding:b,resource:{buffer:g}}))}),h=this.shifts.map((f,m)=>({shift:f,from:m%2,to:1-m%2}));return this.buffers={count:e,records:a,counts:d,project:p(r.project,o,a,i,l[0],c[0]),count_:h.map(({shift:f,from:m})=>p(r.count,o,f,l[m],d)),scan:p(r.scan,o,d),scatter:h.map(({shift:f,from:m,to:g})=>p(r.scatter,o,f,d,l[m],c[m],l[g],c[g])),draw:p(r.draw,o,i,c[0])},this.buffers}};async function ce(){return await(await globalThis.navigator?.gpu?.requestAdapter({powerPreference:"high-performance"}))?.requestDevice()??null}async function Ge(n){let e=document.createElement("canvas").getContext("webgpu");if(!e)return!1;e.configure({device:n,format:navigator.gpu.getPreferredCanvasFormat()});let t=n.createCommandEncoder(),r=e.getCurrentTexture().createView();t.beginRenderPass({colorAttachments:[{view:r,loadOp:"clear",storeOp:"store"}]}).end(),n.queue.submit([t.finish()]);let o=n.queue.onSubmittedWorkDone().then(()=>!0,()=>!1),s=n.lost.then(()=>!1),a=await Promise.race([o,s]);return e.unconfigure(),a}async function Ce(n,e){let t=(h,f)=>n.createComputePipelineAsync({layout:"auto",compute:{module:n.createShaderModule({code:h}),entryPoint:f}}),r=(h,f,m,g)=>{let b=n.createShaderModule({code:h});return n.createRenderPipelineAsync({layout:"auto",primitive:{topology:g},vertex:{module:b,entryPoint:f[0]},fragment:{module:b,entryPoint:f[1],targets:[m]}})},o={color:{srcFactor:"dst-alpha",dstFactor:"one",operation:"add"},alpha:{srcFactor:"zero",dstFactor:"one-minus-src-alpha",operation:"add"}},[s,a,i,l,c,d,p]=await Promise.all([t(te,"project"),t(re,"count"),t(ne,"scan"),t(ae,"scatter"),r(oe,["corner","blend"],{format:ue,blend:o},"triangle-strip"),r(D,["whole","resolve"],{format:e},"triangle-list"),r(D,["whole","resolve"],{format:de},"triangle-list")]);return{project:s,count:a,scan:i,scatter:l,draw:c,resolve:d,resolveToRead:p}}async function pe(n,e){if(e!=="webgl2"){let t=await F.make(n).catch(()=>null);if(t)return t;if(e==="webgpu")throw new Error("it has no WebGPU, which was asked for")}return new R(n)}var S=class extends Error{constructor(t,r,o,s=""){super(`${t}: expected ${r}, received ${o}${s?`; ${s}`:""}`);this.subject=t;this.expected=r;this.received=o;this.remedy=s;this.name="BundleError"}};function u(n,e={},...t){let r=document.createElement(n);for(let[o,s]of Object.entries(e))s!==!1&&r.setAttribute(o,s===!0?"":String(s));return r.append(...t),r}function I(n,e,t){let r=u("button",{class:`round ${e}`,title:n,"aria-label":n});return A(r,t),r}function A(n,e){n.innerHTML=`<svg viewBox="0 0 24 24" aria-hidden="true">${e}</svg>`}var y={play:'<path class="solid" d="M8 5.2v13.6c0 .8.9 1.3 1.5.8l10.2-6.8c.6-.4.6-1.2 0-1.6L9.500 4.400C8.900 3.900 8 4.400 8 5.200z"/>',pause:'<path class="solid" d="M7 5h3.600v14H7zM13.400 5H17v14h-3.600z"/>',settings:'<path d="M4 7h9M17 7h3M4 12h3M11 12h9M4 17h11M19 17h1"/><circle cx="15" cy="7" r="2"/><circle cx="9" cy="12" r="2"/><circle cx="17" cy="17" r="2"/>',close:'<path d="M6 6l12 12M18 6L6 18"/>'};function z(n,e,t){let r=u("output"),o=u("input",{type:"range",min:e.least,max:e.most,step:e.step,"aria-label":n}),s=a=>{o.value=String(a),N(o),r.textContent=a.toFixed(e.step<1?2:0)};return s(e.start),o.addEventListener("input",()=>{s(Number(o.value)),t(Number(o.value))}),o.addEventListener("dblclick",()=>{s(e.start),t(e.start)}),u("label",{class:"row"},u("span",{title:n},n),r,o)}function N(n){let[e,t]=[Number(n.min),Number(n.max)];n.style.setProperty("--share",`${100*(Number(n.value)-e)/(t-e||1)}%`)}var he=.0055,De=.0012,M=.08,Be=.15,Ie=40,fe=1.5;function me(n,e){let t=new Map,r=(a,i)=>{let{orbit:l}=e,c=Math.min(fe,Math.max(-fe,l.elevation+i));e.orbit={...l,azimuth:l.azimuth+a,elevation:c},e.update()},o=a=>{let i=Math.min(Ie,Math.max(Be,e.orbit.distance*a));e.orbit={...e.orbit,distance:i},e.update()},s=(a,i)=>{let l=e.camera(),c=l.width/n.clientWidth;e.orbit=K(e.orbit,a*c,i*c,l),e.update()};n.addEventListener("pointerdown",a=>{n.setPointerCapture(a.pointerId),t.set(a.pointerId,{x:a.clientX,y:a.clientY})});for(let a of["pointerup","pointercancel"])n.addEventListener(a,i=>t.delete(i.pointerId));n.addEventListener("pointermove",a=>{let i=t.get(a.pointerId);if(!i||!e.summary)return;let l={x:a.clientX,y:a.clientY},[c,d]=[l.x-i.x,l.y-i.y];if(t.size===1)a.buttons&6||a.shiftKey?s(c,d):r(-he*c,he*d);else if(t.size===2){let[p]=[...t].filter(([f])=>f!==a.pointerId).map(([,f])=>f),h=f=>Math.max(1,Math.hypot(f.x-p.x,f.y-p.y));o(h(i)/h(l)),s(c/2,d/2)}t.set(a.pointerId,l)}),n.addEventListener("wheel",a=>{a.preventDefault(),e.summary&&o(Math.exp(De*a.deltaY*(a.deltaMode?20:1)))},{passive:!1}),n.addEventListener("contextmenu",a=>a.preventDefault()),n.addEventListener("dblclick",()=>e.resetView()),window.addEventListener("keydown",a=>{if(a.target instanceof HTMLInputElement||a.target instanceof HTMLSelectElement||!e.summary)return;({ArrowLeft:()=>r(-M,0),ArrowRight:()=>r(M,0),ArrowUp:()=>r(0,M),ArrowDown:()=>r(0,-M),"+":()=>o(.9),"-":()=>o(1.1),Home:()=>e.resetView()})[a.key]?.()})}var ze={least:-90,most:90,start:0,step:1},Ne=["Bend","Twist","Tilt"];function ge(n){let e=n.summary,t=[];e.partNames.length>1&&t.push(["Parts",Oe(n)]),e.expressionNames.length&&t.push(["Face",He(n)]),t.push(["Pose",$e(n)],["About",qe(n)]);let r=u("div",{class:"tabs",role:"tablist"}),o=a=>{t.forEach(([,i],l)=>i.hidden=l!==a),[...r.children].forEach((i,l)=>i.setAttribute("aria-selected",String(l===a)))};t.forEach(([a],i)=>{let l=u("button",{role:"tab"},a);l.addEventListener("click",()=>o(i)),r.append(l)});let s=u("section",{class:"panel","aria-label":"Settings",hidden:!0},r,...t.map(([,a])=>a));return o(0),s}function _(...n){return u("div",{class:"page",role:"tabpanel"},...n)}function L(n){let e=n.replaceAll("_"," ").replace(/([a-z])([A-Z])/g,"$1 $2").toLowerCase();return e.charAt(0).toUpperCase()+e.slice(1)}function Oe(n){let e=n.summary.partNames.map((t,r)=>{let o=u("input",{type:"checkbox",checked:!0});return o.addEventListener("change",()=>{o.checked?n.hidden.delete(r):n.hidden.add(r),n.update()}),u("label",{class:"switch"},L(t),o)});return _(...e)}function He(n){let e=u("button",{class:"button"},"Back to the motion"),t=u("div"),r=()=>t.replaceChildren(...n.summary.expressionNames.map((o,s)=>z(L(o),{least:0,most:1,start:0,step:.01},a=>{n.expressions.set(s,a),n.update()})));return e.addEventListener("click",()=>{n.expressions.clear(),n.update(),r()}),r(),_(t,e)}function $e(n){let e=n.summary.jointNames,t=u("select",{"aria-label":"Joint"},...e.map((i,l)=>u("option",{value:l},L(i)))),r=u("div"),o=()=>{let i=Number(t.value),l=[...n.turns.get(i)??[0,0,0]];r.replaceChildren(...Ne.map((c,d)=>z(`${c}, degrees`,{...ze,start:Math.round(l[d]*180/Math.PI)},p=>{l[d]=p*Math.PI/180,l.some(h=>h!==0)?n.turns.set(i,[...l]):n.turns.delete(i),n.update()})))};t.addEventListener("change",o);let s=e.indexOf("left_shoulder");s>=0&&(t.value=String(s));let a=u("button",{class:"button"},"Turn all joints back");return a.addEventListener("click",()=>{n.turns.clear(),n.update(),o()}),o(),_(t,r,a)}function qe(n){let e=n.summary,t=u("dl"),r=(o,s)=>t.append(u("dt",{},o),u("dd",{},s));r("Name",e.name),r("Gaussians",e.count.toLocaleString("en")),r("File",`${(e.bytes/1e6).toFixed(1)} MB`),e.motion&&r("Motion",`${e.motion.frames} frames, ${e.motion.framesPerSecond.toFixed(0)} a second`),r("Renderer",n.renderer.name),e.licence&&r("Licence",e.licence);for(let[o,s]of Object.entries(e.provenance))r(L(o),String(s));return _(t)}var O=[1,.5,.25,2],We=400,U=class{constructor(e,t){this.player=e;this.bar=u("div",{class:"bar"},this.playButton,this.scrub,this.clock,this.speed),document.body.append(this.title,this.menu,this.rates,this.bar,this.welcome),this.showControls(!1),me(t,e),this.listenToControls(),this.listenToFiles(),new ResizeObserver(()=>e.update()).observe(t),e.onpicture=()=>this.refresh(),e.onerror=r=>this.fail(r)}title=u("header",{class:"title"});rates=u("div",{class:"rates"});welcome=u("div",{class:"welcome"});playButton=I("Pause","play",y.pause);scrub=u("input",{type:"range",min:0,max:1,step:.001,"aria-label":"Time"});clock=u("span",{class:"time"});speed=u("button",{class:"speed",title:"Speed"},"1\xD7");menu=I("Settings","menu",y.settings);bar;panel=null;lastRates=0;async open(e){this.say(u("div",{class:"spinner"}),u("h2",{},"Opening the avatar"));try{let t=await this.player.open(await e);this.welcome.replaceChildren(),document.title=t.name,this.title.replaceChildren(u("h1",{},t.name),u("p",{},"SMPLX++ avatar")),this.panel?.remove(),this.panel=ge(this.player),this.title.after(this.panel),A(this.menu,y.settings),this.showControls(!0),this.bar.hidden=!this.player.duration}catch(t){this.fail(t instanceof S||t instanceof Error?t.message:String(t))}}fail(e){let t=e.charAt(0).toUpperCase()+e.slice(1),r=this.chooser("Open another file");if(this.player.summary){let s=u("button",{class:"button"},"Back");s.addEventListener("click",()=>this.welcome.replaceChildren()),r.prepend(s)}this.say(u("h2",{},"This avatar cannot be shown"),u("p",{},`${t}.`),r).classList.add("failed")}invite(){this.say(u("h2",{},"Open an avatar"),u("p",{},"Drop a .avatar file here, or choose one."),this.chooser("Choose a file"))}say(...e){let t=u("div",{class:"card",role:"status"},...e);return this.welcome.replaceChildren(t),t}chooser(e){let t=u("input",{type:"file",accept:".avatar,.zip",hidden:!0});t.addEventListener("change",()=>t.files?.[0]&&this.open(t.files[0].arrayBuffer()));let r=u("button",{class:"button"},e);return r.addEventListener("click",()=>t.click()),u("div",{},r,t)}showControls(e){for(let t of[this.bar,this.menu,this.rates])t.hidden=!e}listenToControls(){let{player:e}=this,t=()=>{e.playing=!e.playing,A(this.playButton,e.playing?y.pause:y.play),this.playButton.title=e.playing?"Pause":"Play"};this.playButton.addEventListener("click",t),window.addEventListener("keydown",r=>{r.key!==" "||r.target instanceof HTMLButtonElement||r.target instanceof HTMLInputElement||(r.preventDefault(),t())}),this.scrub.addEventListener("input",()=>{e.time=Number(this.scrub.value)*e.duration,e.update()}),this.speed.addEventListener("click",()=>{e.speed=O[(O.indexOf(e.speed)+1)%O.length],this.speed.textContent=`${e.speed}\xD7`}),this.menu.addEventListener("click",()=>{this.panel&&(this.panel.hidden=!this.panel.hidden,A(this.menu,this.panel.hidden?y.settings:y.close))})}listenToFiles(){window.addEventListener("dragover",e=>{e.preventDefault(),document.body.classList.add("dropping")}),window.addEventListener("dragleave",e=>{e.relatedTarget||document.body.classList.remove("dropping")}),window.addEventListener("drop",e=>{e.preventDefault(),document.body.classList.remove("dropping");let t=e.dataTransfer?.files[0];t&&this.open(t.arrayBuffer())})}refresh(){let{player:e}=this,t=e.duration;t&&(this.scrub.value=String(e.time/t),N(this.scrub),this.clock.textContent=`${e.time.toFixed(1)} / ${t.toFixed(1)} s`);let r=performance.now();if(r-this.lastRates<We)return;this.lastRates=r;let{fps:o,deform:s,sort:a,draw:i}=e.rates,l=[`pose ${s.toFixed(1)}`];e.renderer.sorts||l.push(`sort ${a.toFixed(1)}`),i!==null&&l.push(`draw ${i.toFixed(1)}`);let c=`${(e.summary.bytes/1e6).toFixed(1)} MB`;this.rates.replaceChildren(u("b",{},`${o.toFixed(o<10?1:0)} fps`),` \xB7 ${l.join(" \xB7 ")} ms \xB7 ${e.renderer.name} \xB7 ${c}`)}};var je="avatar-data",Ve="data-avatar";async function Ye(){document.head.append(u("style",{},$));let n=u("canvas",{class:"stage"});document.body.append(n);let e=new URLSearchParams(location.search).get("renderer"),t=new k(await pe(n,e),n),r=new U(t,n),o=Xe(),s=o?r.open(o):Promise.resolve(r.invite());window.smplxppPlayer={player:t,ready:s,open:a=>r.open(a),picture:async a=>Je(await t.picture(a))}}function Xe(){let n=document.getElementById(je);if(n){let t=Qe(n.textContent??"");return n.remove(),t}let e=new URLSearchParams(location.search).get("avatar")??document.body.getAttribute(Ve);return e?Ke(e):null}async function Ke(n){let e=await fetch(n);if(!e.ok)throw new Error(`${n}: the server says ${e.status} ${e.statusText}`);return e.arrayBuffer()}function Qe(n){let e=atob(n.trim()),t=new Uint8Array(e.length);for(let r=0;r<e.length;++r)t[r]=e.charCodeAt(r);return t.buffer}function Je(n){let e="";for(let t=0;t<n.length;t+=32768)e+=String.fromCharCode(...n.subarray(t,t+32768));return btoa(e)}Ye().catch(n=>{document.body.append(u("div",{class:"welcome"},u("div",{class:"card failed"},u("h2",{},"This browser cannot show the avatar"),u("p",{},n.message))))});})();
